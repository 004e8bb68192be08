"""From a pose to an image: exact ground truth, and rendering with gradients.

The names below need numpy and numba only. The differentiable renderer needs torch and is imported from its
own module, `s2p3.rendering.differentiable`.
"""

from s2p3.rendering.mesh import Mesh
from s2p3.rendering.rasterizer import Raster, Region, projected_region, rasterize, rasterize_pixels

__all__ = ["Mesh", "Raster", "Region", "projected_region", "rasterize", "rasterize_pixels"]
