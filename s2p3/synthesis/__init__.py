"""Training sets: rendered polarization images with exact poses, masks and boxes.

Two backends draw the same scenes: `Analytic`, fast and without shadows, and `PathTraced` by Mitsuba 3.
"""

from s2p3.synthesis.analytic_scene import Analytic
from s2p3.synthesis.depth import DepthSensor
from s2p3.synthesis.domain import CAPTURED, DOMAINS, PLAIN, SYNTHETIC, Domain
from s2p3.synthesis.drawing import draw_scene
from s2p3.synthesis.frames import Recipe, session_camera
from s2p3.synthesis.generate import synthesize
from s2p3.synthesis.informativeness import Informativeness
from s2p3.synthesis.manifest import render_again
from s2p3.synthesis.path_traced import PathTraced
from s2p3.synthesis.scene import Backend, Scene, SceneImage, SceneParameters, render
from s2p3.synthesis.views import Views, ViewsLike

__all__ = [
    "CAPTURED",
    "DOMAINS",
    "PLAIN",
    "SYNTHETIC",
    "Analytic",
    "Backend",
    "DepthSensor",
    "Domain",
    "Informativeness",
    "PathTraced",
    "Recipe",
    "Scene",
    "SceneImage",
    "SceneParameters",
    "Views",
    "ViewsLike",
    "draw_scene",
    "render",
    "render_again",
    "session_camera",
    "synthesize",
]
