"""Label CSV files: round trips, and limits of values."""

import io
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dmrl.errors import SourceError
from dmrl.formats.files.label_csv import COLUMNS, LabelRow, read_labels, write_labels
from dmrl.guards import limits

HEADER = "file,peer,u_px,v_px,depth_m,left_px,top_px,right_px,bottom_px,visible_share\n"
FULL = LabelRow(
    "a.png", "cf2", 1.5, -2.25, 0.75, (1, 2, 3, 4.5), 0.5, "truth", "train", (0.5, 1.5, 0.25)
)


def write_and_read(folder: Path, text: str) -> dict[str, list[LabelRow]]:
    """Write a text to labels.csv; return its rows by image."""
    path = folder / "labels.csv"
    path.write_text(text)
    return read_labels(path, ["a.png", "b.png"])


def format_rows(*rows: LabelRow) -> str:
    """Return the text of a label file with these rows."""
    stream = io.StringIO()
    write_labels(stream, rows)
    return stream.getvalue()


def test_label_rows_are_read_as_written(tmp_path: Path) -> None:
    bare = LabelRow("b.png", "cf3", 4.0, 5.0, 6.0)
    nobody = LabelRow("a.png", "", source="truth", split="train")
    assert write_and_read(tmp_path, format_rows(FULL, bare)) == {"a.png": [FULL], "b.png": [bare]}
    assert write_and_read(tmp_path, format_rows(nobody)) == {"a.png": [nobody]}
    assert (bare.box_px, bare.visible_share, bare.source, bare.split) == ((), 0.0, "hand", None)
    assert bare.sigmas == (0.0, 0.0, 0.0)


def test_cells_match_their_columns_and_unknown_values_are_empty() -> None:
    head, full, bare, nobody = format_rows(
        FULL, LabelRow("b.png", "cf3", 4.0, 5.0, 6.0), LabelRow("b.png", "")
    ).splitlines()
    assert head == ",".join(COLUMNS)
    assert full == "a.png,cf2,1.5000,-2.2500,0.75000,1,2,3,4.5,0.5000,truth,train,0.5,1.5,0.25"
    assert bare == "b.png,cf3,4.0000,5.0000,6.00000,,,,,,hand,,,,"
    assert nobody == "b.png,,,,,,,,,,hand,,,,"


def test_label_csv_columns_equal_label_fields() -> None:
    assert FULL.to_fields() == {
        **{"peer": "cf2", "u_px": 1.5, "v_px": -2.25, "depth_m": 0.75, "visible_share": 0.5},
        **{"source": "truth", "sigma_u_px": 0.5, "sigma_v_px": 1.5, "sigma_depth_m": 0.25},
        "box_px": [1, 2, 3, 4.5],
    }


@given(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.floats(0.01, 100))
def test_a_point_is_kept_to_a_ten_thousandth_of_a_pixel(u: float, v: float, depth: float) -> None:
    cells = LabelRow("a.png", "cf2", u, v, depth).to_cells()
    assert [float(cell) for cell in cells[2:5]] == pytest.approx((u, v, depth), abs=5.1e-5)


@pytest.mark.parametrize(
    ("cells", "complaint"),
    [
        ("1,2,0.001,,,,,", ""),
        ("1,2,0,,,,,", "depth_m is 0"),
        ("1,2,3,1,2,3,4,0", ""),
        ("1,2,3,1,2,3,4,1", ""),
        ("1,2,3,1,2,3,4,1.01", "visible_share is 1.01"),
        ("1,2,3,1,2,3,4,-0.01", "visible_share is -0.01"),
        ("1,2,3,1,2,1,4,", "not a box"),
        ("1,2,3,1,2,3,2,", "not a box"),
        ("1,2,3,4,2,3,5,", "not a box"),
        ("1,2,3,1,6,3,5,", "not a box"),
        ("1,2,3,1,2,3,,", "not a box"),
        ("1,2,,,,,,", ""),
        (",,,1,2,3,4,", ""),
        (",2,1,,,,,", "u_px is '', not a number"),
        ("1,2,inf,,,,,", "depth_m is 'inf', not a number"),
        ("1_0,2,,,,,,", "u_px is '1_0', not a number"),
    ],
)
def test_label_values_have_limits(tmp_path: Path, cells: str, complaint: str) -> None:
    text = f"{HEADER}a.png,cf2,{cells}\n"
    if not complaint:
        assert len(write_and_read(tmp_path, text)["a.png"]) == 1
        return
    with pytest.raises(SourceError, match=complaint):
        write_and_read(tmp_path, text)


def test_a_source_that_no_command_can_choose_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"2: source is 'Truth'\. It must be truth, estimate"):
        write_and_read(tmp_path, "file,peer,u_px,v_px,source\na.png,cf2,1,2,Truth\n")


@pytest.mark.parametrize("cell", range(7))
def test_row_without_peer_must_have_empty_cells(tmp_path: Path, cell: int) -> None:
    cells = ["5" if k == cell else "" for k in range(8)]
    with pytest.raises(SourceError, match="without a peer"):
        write_and_read(tmp_path, f"{HEADER}a.png,,{','.join(cells)}\n")


def test_one_peer_may_have_labels_of_several_sources(tmp_path: Path) -> None:
    rows = [LabelRow("a.png", "cf2", 1, 2, 3, source=source) for source in ("truth", "hand")]
    rows.append(LabelRow("a.png", "cf3", 1, 2, 3))
    assert write_and_read(tmp_path, format_rows(*rows)) == {"a.png": rows}
    with pytest.raises(SourceError, match=r":5: a\.png has cf3 from hand already"):
        write_and_read(tmp_path, format_rows(*rows, rows[-1]))
    with pytest.raises(SourceError, match=r":3: .*empty peer, so it may have no other"):
        write_and_read(tmp_path, format_rows(LabelRow("a.png", ""), rows[0]))


def test_number_of_rows_of_an_image_is_limited(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "PEERS", 3)
    rows = [LabelRow("a.png", f"cf{k}", 1, 2, 3) for k in range(4)]
    assert len(write_and_read(tmp_path, format_rows(*rows[:3]))["a.png"]) == 3
    with pytest.raises(SourceError, match=r":5: a\.png has more than 3 rows"):
        write_and_read(tmp_path, format_rows(*rows))


def test_misspelled_column_suggests_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"unknown column 'sigma_u'\. Did you mean sigma_u_px\?"):
        write_and_read(tmp_path, "file,peer,u_px,v_px,depth_m,sigma_u\n")
    with pytest.raises(SourceError, match=r"unknown column 'zz'\. Known are file, peer"):
        write_and_read(tmp_path, "file,peer,u_px,v_px,depth_m,zz\n")


def test_row_without_peer_keeps_its_source(tmp_path: Path) -> None:
    head = "file,peer,u_px,v_px,depth_m,source\n"
    found = write_and_read(tmp_path, f"{head}a.png,,,,,\nb.png,,,,,truth\n")
    assert (found["a.png"][0].source, found["b.png"][0].source) == ("hand", "truth")
    found = write_and_read(tmp_path, f"{head}a.png,cf2,1,2,3,\nb.png,cf2,1,2,3,truth\n")
    assert (found["a.png"][0].source, found["b.png"][0].source) == ("hand", "truth")


@given(
    st.lists(st.floats(-500, 500).map(lambda x: round(x, 3)), min_size=4, max_size=4, unique=True),
    st.lists(st.integers(0, 8), min_size=3, max_size=3),
    st.integers(0, 100),
)
@pytest.mark.heavy
def test_label_rows_round_trip(
    tmp_path_factory: pytest.TempPathFactory, edges: list[float], sigmas: list[int], share: int
) -> None:
    (left, right), (top, bottom) = sorted(edges[:2]), sorted(edges[2:])
    row = LabelRow(
        "a.png",
        "cf9",
        *(left, top, 0.25),
        box_px=tuple(float(f"{edge:g}") for edge in (left, top, right, bottom)),
        visible_share=share / 100,
        sigmas=(sigmas[0] / 4, sigmas[1] / 4, sigmas[2] / 4),
    )
    if row.box_px[0] < row.box_px[2] and row.box_px[1] < row.box_px[3]:
        assert write_and_read(tmp_path_factory.getbasetemp(), format_rows(row)) == {"a.png": [row]}
