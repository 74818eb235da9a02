"""Generated rooms: perspective, occlusion, and the table of items."""

import numpy as np
import pytest

from dmrl.rendering.backgrounds import room_items
from dmrl.rendering.backgrounds.room_items import draw_item, list_items
from dmrl.rendering.backgrounds.room_view import RoomView, Surface, build_turn
from dmrl.rendering.backgrounds.rooms import draw_numbered_room, draw_room

GREY, DARK, WHITE = np.full(3, 0.5), np.full(3, 0.1), np.full(3, 0.9)
LOW, HIGH = np.array([-3.0, -3.0, 0.0]), np.array([5.0, 3.0, 3.0])


def build_level_view(bend: float = 1e-3) -> RoomView:
    """Return a view of 200 x 140 px from a level camera, 1 m above the floor, without lamps."""
    size = (200, 140)
    rng = np.random.default_rng(0)
    return RoomView(rng, size, 100.0, bend, 1.0, build_turn(0, 0, 0), np.zeros((0, 3)), 1.0)


def paint(
    view: RoomView, *, wall: Surface | None = None, floor: Surface | None = None
) -> np.ndarray:
    """Return the picture (140, 200, 3) of a room, grey where no surface is given."""
    plain = Surface(GREY, GREY, grain=0.0)
    surfaces = [wall or plain] * 4 + [floor or plain, plain]
    return view.paint(LOW, HIGH, surfaces).to_rgb()


def test_a_box_stands_where_the_camera_projects_it() -> None:
    view = build_level_view()
    view.start_item(2.0)
    view.draw_box((2.0, 0.5, 0.0), (0.2, 0.4, 0.6), 0.0, DARK)
    rows, columns = np.nonzero(paint(view).mean(axis=2) < 0.3)
    near = 100 / 1.9  # pixels a metre at the front of the box
    assert columns.mean() + 0.5 == pytest.approx(100 - 0.5 * near, abs=2)
    assert np.ptp(columns) + 1 == pytest.approx(0.4 * near, abs=3)
    assert rows.max() + 1 == pytest.approx(70 + near, abs=2)
    # The highest row is at the far edge of the top.
    assert rows.min() == pytest.approx(70 + 0.4 * 100 / 2.1, abs=2)


def test_near_items_hide_far_ones_in_any_order() -> None:
    pictures = []
    for order in ((1.5, 3.0), (3.0, 1.5)):
        view = build_level_view()
        for far in order:
            view.start_item(far)
            view.draw_box((far, 0.0, 0.0), (0.1, 0.5, 1.5), 0.0, DARK if far < 2 else WHITE)
        pictures.append(paint(view))
    assert (pictures[0] == pictures[1]).all()
    assert pictures[0][75, 100].max() < 0.2


def test_tiles_get_smaller_with_distance() -> None:
    floor = Surface(WHITE, DARK, "tiles", (0.5, 0.5), joint=0.06, grain=0.0)
    picture = paint(build_level_view(), floor=floor).mean(axis=2)
    wide = []
    for row in (100, 135):  # 3.3 and 1.5 m away
        dark = np.flatnonzero(np.diff((picture[row] < 0.6).astype(int)) > 0)
        wide.append(np.median(np.diff(dark)))
    assert wide[1] / wide[0] == pytest.approx((135.5 - 70) / (100.5 - 70), rel=0.15)


def test_lens_distortion_applies_to_walls_and_items() -> None:
    view = build_level_view(bend=0.1)
    uv, depth = view.project(np.array([[2.0, 1.5, 1.0]]))
    straight, _ = build_level_view().project(np.array([[2.0, 1.5, 1.0]]))
    assert depth[0] == 2.0
    assert straight[0, 0] < uv[0, 0] < 100
    rays = [ray.reshape(140, 200) for ray in view._pixel_rays()]
    u, v = int(uv[0, 0]), int(uv[0, 1])
    assert rays[1][v, u] / rays[0][v, u] == pytest.approx(0.75, abs=0.02)


@pytest.mark.parametrize("where", ["wall", "flat", "standing", "small"])
@pytest.mark.heavy
def test_every_item_of_the_table_can_be_drawn(where: str, monkeypatch: pytest.MonkeyPatch) -> None:
    bare = paint(build_level_view())
    for item in list_items(where):
        monkeypatch.setattr(
            room_items,
            "list_items",
            lambda of, item=item: (item,) if of == where else list_items(of),
        )
        seen = 0
        for seed in range(4):
            view = build_level_view()
            view.rng = np.random.default_rng(seed)
            draw_item(view, where, np.array([2.0, 0.0, 0.0]), 0.5)
            seen += (paint(view) != bare).any()
        assert seen, item["name"]


@pytest.mark.heavy
def test_the_number_decides_a_room_and_rooms_have_dark_and_bright_pixels() -> None:
    assert (draw_numbered_room(5) == draw_numbered_room(5)).all()
    assert (draw_numbered_room(5) != draw_numbered_room(6)).any()
    rooms = np.stack([draw_numbered_room(k) for k in range(12)]).mean(axis=-1)
    assert (rooms < 50).mean() > 0.03
    assert (rooms > 200).mean() > 0.03
    assert draw_room(np.random.default_rng(0), 90, 50).shape == (50, 90, 3)
