"""The scenewise format of the BOP benchmark; `dataset.importers` reads it back."""

from dataset.bop.export import export_bop
from dataset.bop.scene import Drawn

__all__ = ["Drawn", "export_bop"]
