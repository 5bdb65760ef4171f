"""Lamps with a measured distribution of light: IES LM-63 files and their luminous flux."""

# What users see.
__all__ = ["Photometry", "read_ies"]

from ._file import read_ies as read_ies
from ._photometry import Photometry as Photometry
