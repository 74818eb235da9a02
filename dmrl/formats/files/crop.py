"""Cropping and scaling of images to one size, with their labels and calibration."""

from dataclasses import dataclass, replace

from dmrl.formats.files.label_csv import LabelRow
from dmrl.geometry.frames import Camera
from dmrl.images import codec


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
