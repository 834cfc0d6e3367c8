"""Localisation of new pictures in a finished run.

Takes a finished run and pictures.
Gives poses with covariances; the run stays as it is.
"""

from gsba.localization.localizer import LocalizedFrame, Localizer
from gsba.localization.output import write_localized
from gsba.localization.photo_localizer import localize_all, localize_photos
from gsba.localization.photos import read_photo
from gsba.localization.pictures import find_pictures

__all__ = [
    "LocalizedFrame",
    "Localizer",
    "find_pictures",
    "localize_all",
    "localize_photos",
    "read_photo",
    "write_localized",
]
