"""Conversion of the pictures of a source to images of a recording: 8 bits, upright, one size.

PNG and JPEG keep their bytes where nothing changes. Every kind of change is reported once, with the
number of pictures and the flag that decides it.
"""

from collections import Counter
from dataclasses import dataclass, field, replace

from dmrl.errors import SettingError, SourceError
from dmrl.formats.base import SOURCE_OPTIONS, Options
from dmrl.formats.files.label_csv import LabelRow
from dmrl.geometry.camera_file import warn_of_mount
from dmrl.geometry.frames import AIDECK, AIDECK_CORNER_PX, AIDECK_SENSOR_PX, Camera
from dmrl.guards import limits
from dmrl.images import codec
from dmrl.images.bayer import BAYER_MIN_PX, demosaic
from dmrl.samples.sample import Sample, build_calibration, build_image
from dmrl.terminal.left_out import leave_out
from dmrl.terminal.progress import say


@dataclass(frozen=True, slots=True)
class Crop:
    """The largest centred part of an image with another aspect ratio, scaled.

    Parameters
    ----------
    from_width_px, from_height_px
        Size of the image.
    width_px, height_px
        Size of the result.
    margin_px
        Left and top margin around the centred area that is used.
    """

    from_width_px: int
    from_height_px: int
    width_px: int
    height_px: int
    margin_px: tuple[int, int] = (0, 0)

    @property
    def changes(self) -> bool:
        """Whether the image needs to be cropped or scaled."""
        return (self.from_width_px, self.from_height_px) != (self.width_px, self.height_px)

    @property
    def scale(self) -> float:
        """Pixels of the result per pixel of the image, the same in both directions."""
        width_px = self.from_width_px - 2 * self.margin_px[0]
        height_px = self.from_height_px - 2 * self.margin_px[1]
        return max(self.width_px / width_px, self.height_px / height_px)

    @property
    def corner_px(self) -> tuple[float, float]:
        """Left and top of the part that is kept."""
        left = (self.from_width_px - self.width_px / self.scale) / 2
        top = (self.from_height_px - self.height_px / self.scale) / 2
        return max(left, 0.0), max(top, 0.0)

    def crop_image(self, rgb: codec.Rgb) -> codec.Rgb:
        """Return the kept part of an image, (height_px, width_px, 3)."""
        left, top = self.corner_px
        right = min(left + self.width_px / self.scale, self.from_width_px)
        bottom = min(top + self.height_px / self.scale, self.from_height_px)
        return codec.crop_and_scale(rgb, (left, top, right, bottom), self.width_px, self.height_px)

    def crop_label(self, row: LabelRow) -> LabelRow:
        """Return a label in the pixels of the result; its box is clipped, or empty if outside."""
        left, top = self.corner_px
        sigma_u, sigma_v, sigma_depth = row.sigmas
        return replace(
            row,
            u_px=(row.u_px - left) * self.scale,
            v_px=(row.v_px - top) * self.scale,
            box_px=self._crop_box(row.box_px),
            sigmas=(sigma_u * self.scale, sigma_v * self.scale, sigma_depth),
        )

    def _crop_box(self, box_px: tuple[float, ...]) -> tuple[float, ...]:
        if not box_px:
            return ()
        left, top = self.corner_px
        x0, x1 = (min(max((x - left) * self.scale, 0), self.width_px) for x in box_px[::2])
        y0, y1 = (min(max((y - top) * self.scale, 0), self.height_px) for y in box_px[1::2])
        return (x0, y0, x1, y1) if x0 < x1 and y0 < y1 else ()

    def crop_camera(self, camera: Camera) -> Camera:
        """Return the calibration of the result."""
        left, top = self.corner_px
        return replace(
            camera,
            width_px=self.width_px,
            height_px=self.height_px,
            fx_px=camera.fx_px * self.scale,
            fy_px=camera.fy_px * self.scale,
            cx_px=(camera.cx_px - left) * self.scale,
            cy_px=(camera.cy_px - top) * self.scale,
        )


PICTURE_OPTIONS = SOURCE_OPTIONS | {"camera", "size_px", "raw", "bits", "as_stored"}
"""Options that have an effect on encoded pictures."""


SCALE_HINT = (
    f"Recordings take {limits.FRAME_PIXELS // 1_000_000} million pixels an image. Scale them: "
    "--width-px 640 --height-px 480"
)

TURNED_HINT = (
    "is turned by EXIF, so its labels and calibration may be of either picture. Pass --upright if "
    "they are of the one that viewers show, --as-stored if of the stored one"
)


def scaling_words(bits: int) -> str:
    """Return the words that state how pixels of 16 bits become 8."""
    return f"16 bits scaled to 8, {2**bits - 1} to 255 (--bits)"


@dataclass(slots=True)
class PictureConverter:
    """Converter of the pictures of one camera.

    Parameters
    ----------
    options
        ``robot``, ``camera``, ``size_px``, ``raw``, ``bits`` and ``as_stored``.
    source
        Source of the pictures, for reports.
    """

    options: Options
    source: object
    _converted: int = 0
    _changes: Counter[str] = field(default_factory=Counter)

    def convert(
        self, time_ns: int, data: bytes, where: object, *, labelled: bool = False
    ) -> tuple[Crop, list[Sample]] | None:
        """Convert an encoded picture; leave it out and return None if it cannot be decoded.

        Raises
        ------
        SettingError
            As `convert_pixels`, or if EXIF turns a picture with labels or a camera, and nobody said
            of which picture they are.
        """
        try:
            return self.convert_pixels(time_ns, *self._decode(data, where, labelled), where)
        except SourceError as e:
            leave_out(codec.UNDECODABLE, e)
            return None

    def convert_pixels(
        self, time_ns: int, rgb: codec.Rgb, kept: tuple[bytes, str] | None, where: object
    ) -> tuple[Crop, list[Sample]]:
        """Convert the pixels of a picture.

        Parameters
        ----------
        time_ns
            Time of exposure.
        rgb
            (H, W, 3), uint8.
        kept
            Its encoded bytes and format, which are written if the size stays; None: PNG.
        where
            Name of the picture in errors.

        Returns
        -------
        tuple
            The crop, for labels; the image, after the calibration if it is the first image.

        Raises
        ------
        SettingError
            If the camera does not have the size of the picture, or the picture is not raw.
        SourceError
            If the picture is larger than any command reads from a recording.
        """
        crop = _build_crop(rgb.shape[1], rgb.shape[0], where, self.options)
        if crop.width_px * crop.height_px > limits.FRAME_PIXELS:
            raise SourceError(f"{where} is {crop.width_px} x {crop.height_px} px. {SCALE_HINT}")
        if crop.changes:
            rgb, kept = crop.crop_image(rgb), None
        image = build_image(time_ns, self.options.robot, *(kept or (codec.encode_png(rgb), "png")))
        self._converted += 1
        if self._converted > 1 or self.options.camera is None:
            return crop, [image]
        warn_of_mount(self.options.robot, self.options.camera)
        camera = crop_camera(crop, self.options.camera)
        return crop, [build_calibration(time_ns, self.options.robot, camera), image]

    def _decode(
        self, data: bytes, where: object, labelled: bool
    ) -> tuple[codec.Rgb, tuple[bytes, str] | None]:
        """Return the pixels of an encoded picture, and its bytes if they may be kept."""
        header = codec.read_header(data, where)
        upright = not self.options.as_stored
        turned = upright and header.is_turned
        # Some tools label, or calibrate, the picture that viewers show, others the stored one.
        if turned and self.options.as_stored is None and (labelled or self.options.camera):
            raise SettingError(f"{where} {TURNED_HINT}")
        changes = {
            scaling_words(self.options.bits): header.has_16_bits,
            "turned upright by EXIF (--as-stored keeps them)": turned,
            "one image of several used, the first": header.is_animated,
        }
        rgb = header.decode(limits.PIXELS, bits=self.options.bits, upright=upright)
        if self.options.raw:
            rgb = _demosaic(rgb, where)
        self._changes.update(what for what, changed in changes.items() if changed)
        keeps = not any(changes.values()) and header.kind in ("png", "jpeg")
        return rgb, (data, header.kind) if keeps and not self.options.raw else None

    def report(self) -> None:
        """Print a line for each kind of change."""
        for change, count in self._changes.items():
            say(f"{self.source}: {count} pictures: {change}")


def _demosaic(rgb: codec.Rgb, where: object) -> codec.Rgb:
    if (rgb != rgb[..., :1]).any():
        raise SettingError(f"{where} has colours already, so it is not raw. Remove --raw")
    if min(rgb.shape[:2]) < BAYER_MIN_PX:
        raise SourceError(f"{where} is smaller than {BAYER_MIN_PX} x {BAYER_MIN_PX} pixels")
    return demosaic(rgb[..., 0].copy())


def _build_crop(width_px: int, height_px: int, where: object, options: Options) -> Crop:
    camera, size = options.camera, (width_px, height_px)
    if camera is None or size == _camera_size(camera):
        return Crop(*size, *(options.size_px or size))
    if size == AIDECK_SENSOR_PX and _camera_size(camera) == _camera_size(AIDECK):
        wanted = options.size_px or _camera_size(AIDECK)
        return Crop(*size, *wanted, (0, 0) if wanted == size else AIDECK_CORNER_PX)
    raise SettingError(
        f"{where} is {width_px}x{height_px} px, its camera {camera.width_px}x"
        f"{camera.height_px}. Pass the calibration of images of its size"
    )


def _camera_size(camera: Camera) -> tuple[int, int]:
    return camera.width_px, camera.height_px


def crop_camera(crop: Crop, camera: Camera) -> Camera:
    """Return the camera of the cropped images, from that of the stored ones.

    A camera smaller than the stored images is centred in them.
    """
    left = (crop.from_width_px - camera.width_px) / 2
    top = (crop.from_height_px - camera.height_px) / 2
    stored = replace(camera, cx_px=camera.cx_px + left, cy_px=camera.cy_px + top)
    return crop.crop_camera(stored)
