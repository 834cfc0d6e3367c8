"""Localisation of new pictures in a finished run.

Takes a finished run and pictures.
Gives poses with covariances; the run stays as it is.
"""

from gsba.localization.localizer import LocalizedFrame, Localizer, localize_all
from gsba.localization.output import write_localized
from gsba.localization.pictures import find_pictures

__all__ = ["LocalizedFrame", "Localizer", "find_pictures", "localize_all", "write_localized"]
