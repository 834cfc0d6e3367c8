"""Localisation of new pictures in a finished run.

Takes a finished run and pictures.
Gives poses with covariances; the run stays as it is.
"""

from gsba.localization.all_pictures import localize_all
from gsba.localization.localizer import LocalizedFrame, Localizer
from gsba.localization.output import write_localized
from gsba.localization.photo_localizer import LocalizedPhotos, PhotoCamera, localize_photos
from gsba.localization.photos import read_photo
from gsba.localization.pictures import find_pictures

__all__ = [
    "LocalizedFrame",
    "LocalizedPhotos",
    "Localizer",
    "PhotoCamera",
    "find_pictures",
    "localize_all",
    "localize_photos",
    "read_photo",
    "write_localized",
]
