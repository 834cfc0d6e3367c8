"""Localisation of pictures of several kinds: panoramas one by one, photos together."""

from collections.abc import Sequence

from gsba.localization.localizer import LocalizedFrame, Localizer
from gsba.localization.photo_localizer import LocalizedPhotos, localize_photos
from gsba.localization.photos import Photo, read_photo
from gsba.localization.pictures import Picture
from gsba.log import GsbaError, track


def localize_all(localizer: Localizer, pictures: Sequence[Picture]) -> LocalizedPhotos:
    """Localise panoramas and photos; one that cannot be read is refused with the reason.

    Returns:
        Frames in the order of the pictures, and the cameras of photos.
    """
    found: dict[str, LocalizedFrame] = {}
    photos: list[Photo] = []
    for picture in track(pictures, "localising", len(pictures)):
        try:
            if picture.frames is not None:
                given = picture.frames, picture.frame, picture.camera
                found[picture.name] = localizer.localize_frame(*given)
                continue
            assert picture.path is not None
            if picture.photo:
                photos.append(read_photo(picture.path))
            else:
                found[picture.name] = localizer.localize(picture.path, picture.name)
        except GsbaError as error:
            found[picture.name] = LocalizedFrame.refused(picture.name, str(error))
    together = localize_photos(localizer, photos)
    found |= {frame.name: frame for frame in together.frames}
    return LocalizedPhotos(tuple(found[picture.name] for picture in pictures), together.cameras)
