"""The scenewise format of the BOP benchmark: sessions to it, and back."""

from dataset.bop.export import Drawn, export_bop
from dataset.bop.importing import import_bop

__all__ = ["Drawn", "export_bop", "import_bop"]
