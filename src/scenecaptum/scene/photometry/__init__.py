"""Lamps with a measured distribution of light: IES LM-63 files, their luminous flux, and the light in a scene."""

# What users see.
__all__ = ["Photometry", "ies_lamp", "read_ies"]

from ._file import read_ies as read_ies
from ._lamp import ies_lamp as ies_lamp
from ._photometry import Photometry as Photometry
