"""The scenewise format of the BOP benchmark: sessions to it, and back."""

from dataset.bop.export import export_bop
from dataset.bop.importing import import_bop
from dataset.bop.scene import Drawn

__all__ = ["Drawn", "export_bop", "import_bop"]
