"""Other data sets as sessions: their mosaics rebuilt without loss, their units asked for and never
guessed."""

from dataset.importers.bop import import_bop
from dataset.importers.housecat6d import import_housecat6d
from dataset.importers.ppp_net import import_ppp_net
from dataset.importers.raw_folder import import_raw_folder
from dataset.importers.units import UNITS, Unit

__all__ = ["UNITS", "Unit", "import_bop", "import_housecat6d", "import_ppp_net", "import_raw_folder"]
