import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl.cli import app
from dmrl.errors import RecordingError, SettingError
from dmrl.evaluation.detection_report import Evaluation, describe_evaluation
from dmrl.images.codec import encode_png
from dmrl.messages import STATUS_AMBIGUOUS, message_class
from dmrl.recording import SPLIT_METADATA, Provenance, RecordingWriter
from dmrl.stages import convert, evaluate, merge, predict
from dmrl.stages.evaluate import Settings, run

Peers = Sequence[Mapping[str, Any]]
PICTURE = message_class("CompressedImage")(
    data=encode_png(np.zeros((48, 64, 3), np.uint8)), format="png"
)
FAST = Settings(draws=20)


def label(u_px: float, v_px: float, depth_m: float = 1.2, **more: Any) -> dict[str, Any]:
    """Return the fields of a label of truth."""
    return {"u_px": u_px, "v_px": v_px, "depth_m": depth_m, "source": "truth", **more}


def detect(
    u_px: float, v_px: float, confidence: float = 0.9, depth_m: float = 1.0
) -> dict[str, Any]:
    """Return the fields of a detection."""
    return {"u_px": u_px, "v_px": v_px, "depth_m": depth_m, "confidence": confidence}


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Return a function that writes images of 64 x 48 px with (labels, detections) or None each."""

    def write_recording(
        robots: Mapping[str, Sequence[tuple[Peers | None, Peers | None]]],
        split: Mapping[str, str] | None = None,
        threshold: float = 0.0,
        name: str = "flight.mcap",
        looked: Sequence[str] = (),
    ) -> Path:
        path = tmp_path / name
        with RecordingWriter(path, Provenance("test")) as sink:
            if split:
                sink.add_metadata(SPLIT_METADATA, dict(split))
            for robot, images in robots.items():
                for k, (peers, detections) in enumerate(images):
                    sink.write(k, f"/{robot}/camera/image", PICTURE)
                    if peers is not None:
                        labels = message_class("PeerLabels")(peers=peers, sources=looked)
                        sink.write(k, f"/{robot}/labels", labels)
                    if detections is not None:
                        fields = {"detections": detections, "threshold": threshold}
                        own = message_class("Detections")(**fields)
                        sink.write(k, f"/{robot}/detections", own)
        return path

    return write_recording


def measure(path: Path, settings: Settings = FAST) -> dict[str, Any]:
    """Evaluate a recording; return its overall figures."""
    overall = describe_evaluation([path], run([path], None, settings))["overall"]
    return {k: v["value"] if isinstance(v, dict) else v for k, v in overall.items()}


def test_labels_and_detections_of_one_image_are_matched(write: Callable[..., Path]) -> None:
    near = ([label(10, 10)], [detect(13, 14)])
    path = write({"cf1": [near, ([label(40, 10)], [detect(40, 10)])]})
    got = measure(path)
    assert (got["labels"], got["images"], got["unmatched_labels"]) == (2, 2, 0)
    assert (got["median_px"], got["mean_px"], got["within_8_px"]) == (2.5, 2.5, 1)
    assert got["depth_mae_m"] == pytest.approx(0.2)


def test_robots_are_not_mixed(write: Callable[..., Path]) -> None:
    here, there = label(10, 10), label(50, 40)
    path = write({"cf1": [([here], [detect(10, 10)])], "cf2": [([there], [detect(50, 40)])]})
    assert measure(path)["mean_px"] == 0
    assert measure(path)["labels"] == 2


def test_empty_image_of_a_labelling_source_counts_as_negative(write: Callable[..., Path]) -> None:
    other = ([label(40, 10, source="estimate")], [detect(40, 10)])
    images = {"cf1": [([label(10, 10)], [detect(10, 10)]), other]}
    assert measure(write(images))["precision"] == 1
    assert measure(write(images, looked=["truth"], name="b.mcap"))["precision"] == 0.5


def test_recording_without_peers_can_be_evaluated(write: Callable[..., Path]) -> None:
    empty = write({"cf1": [([], [detect(10, 10)])]}, name="empty.mcap")
    assert run([empty], None, FAST).pairs.images == 1
    good = write({"cf1": [([label(10, 10)], [detect(10, 10)])]})
    both = run([empty, good], None, FAST)
    assert both.bands[0].figures["precision"].value == 0.5


def test_two_messages_of_one_image_count_together(
    write: Callable[..., Path], tmp_path: Path
) -> None:
    true = write({"cf1": [([label(10, 10)], [detect(13, 14)])] * 3}, looked=["truth"])
    hand = tmp_path / "hand.mcap"
    with RecordingWriter(hand, Provenance("test")) as sink:
        for k in range(3):
            marks = [label(13, 14, source="hand")]
            sink.write(k, "/cf1/labels", message_class("PeerLabels")(peers=marks, sources=["hand"]))
    for first, second in ((true, hand), (hand, true)):
        both = tmp_path / f"{first.stem}-first.mcap"
        merge.run([first, second], both)
        assert measure(both)["median_px"] == 5
        assert measure(both, Settings(against="hand", draws=5))["median_px"] == 0


@pytest.mark.usefixtures("empty_figures")
def test_recordings_are_judged_together(
    write: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # Robot and times are equal. Only the recordings distinguish the images.
    near = write({"cf1": [([label(10, 10)], [detect(13, 14)])] * 2}, name="near.mcap")
    far = write({"cf1": [([label(50, 40)], [detect(50, 10)])]}, name="far.mcap")
    evaluate.command([near, far], settings=FAST, plots_to=tmp_path / "plots", as_json=True)
    output = json.loads(capsys.readouterr().out)
    assert [source["name"] for source in output["recordings"]] == ["near.mcap", "far.mcap"]
    assert (output["images"], output["overall"]["median_px"]["value"]) == (3, 5)
    assert output["overall"]["mean_px"]["value"] == pytest.approx(40 / 3)
    assert (tmp_path / "plots" / "examples.png").is_file()
    evaluate.command([near, far], settings=FAST)
    assert "2 recordings: 3 images against truth" in capsys.readouterr().out
    with pytest.raises(RecordingError, match="given twice"):
        run([near, far, near], None, FAST)


def test_two_models_on_the_same_images_are_compared_and_not_pooled(
    write: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    names = ("a.mcap", "b.mcap")
    both = [write({"cf1": [([label(10, 10)], [detect(13, k)])] * 2}, name=names[k]) for k in (0, 1)]
    evaluate.command(both, settings=FAST)
    said = capsys.readouterr().out
    assert "4 images against truth, each by two models" in said
    assert said.count("median error, px") == 1  # in the comparison only


def test_only_the_chosen_source_counts(write: Callable[..., Path]) -> None:
    both = [label(10, 10), label(10, 18, source="published")]
    path = write({"cf1": [(both, [detect(10, 10)])]})
    assert measure(path)["bias_v_px"] == 0
    assert measure(path, Settings(against="published", draws=5))["bias_v_px"] == -8


def test_images_that_cannot_be_judged_are_left_out_and_counted(
    write: Callable[..., Path],
) -> None:
    good = ([label(10, 10)], [detect(10, 10)])
    path = write(
        {
            "cf1": [
                good,
                (None, [detect(10, 10)]),
                ([label(10, 10)], None),
                ([label(10, 10, source="hand")], [detect(10, 10)]),
                ([label(10, 10), label(20, 10, status=STATUS_AMBIGUOUS)], [detect(10, 10)]),
                ([label(10, 10), label(-3, 10)], [detect(10, 10)]),
                ([], [detect(10, 10)]),
            ]
        }
    )
    evaluation = run([path], None, FAST)
    assert evaluation.pairs.images == 4
    assert len(evaluation.pairs.labels) == 3
    left_out = {
        "images with labels from other sources only": 1,
        "images with a label that is not OK": 1,
        "labels outside their image": 1,
    }
    assert evaluation.pairs.left_out == left_out
    assert measure(path)["precision"] == pytest.approx(2 / 3)
    assert measure(path)["recall"] == pytest.approx(2 / 3)
    partial = Settings(draws=20, partial=True)
    left_out["images without detections"] = 1
    assert run([path], None, partial).pairs.left_out == left_out
    assert measure(path, partial)["recall"] == 1


def test_images_without_detections_count_as_misses(
    write: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    good, bad = ([label(10, 10)], [detect(10, 10)]), ([label(10, 10)], [detect(50, 40, 0.2)])
    unseen, empty = ([label(10, 10)], None), ([label(10, 10)], [])
    whole = measure(write({"cf1": [good, *[bad] * 4]}))
    picked = write({"cf1": [good, *[unseen] * 4]}, name="picked.mcap")
    told = measure(write({"cf1": [good, *[empty] * 4]}, name="told.mcap"))
    got = measure(picked)
    assert got == told
    assert got["ap_16_px"] == whole["ap_16_px"] == 0.2
    assert (got["recall"], got["within_8_px"], got["unmatched_labels"]) == (0.2, 0.2, 4)
    evaluate.command([picked], settings=FAST)
    assert "4 images have no Detections message" in capsys.readouterr().out
    partial = Settings(draws=20, partial=True)
    assert measure(picked, partial)["ap_16_px"] == 1
    evaluate.command([picked], settings=partial)
    assert "1 images against truth, only those with detections" in capsys.readouterr().out
    said = describe_evaluation([picked], run([picked], None, partial))
    assert (said["partial"], said["images_without_detections"]) == (True, 0)
    said = describe_evaluation([picked], run([picked], None, FAST))
    assert (said["partial"], said["images_without_detections"]) == (False, 4)


def test_a_camera_that_never_detected_counts_too(write: Callable[..., Path]) -> None:
    good, unseen = ([label(10, 10)], [detect(10, 10)]), ([label(10, 10)], None)
    path = write({"cf1": [good], "cf2": [unseen]})
    assert measure(path)["recall"] == 0.5
    assert measure(path, Settings(draws=20, partial=True))["recall"] == 1


def test_labels_without_images_are_omitted(write: Callable[..., Path], tmp_path: Path) -> None:
    path = write({"cf1": [([label(10, 10)], [detect(10, 10)])]})
    late = tmp_path / "late.mcap"
    with RecordingWriter(late, Provenance("test")) as sink:
        sink.write(77, "/cf1/labels", message_class("PeerLabels")(peers=[label(20, 20)]))
    both = tmp_path / "both.mcap"
    merge.run([path, late], both)
    evaluation = run([both], None, FAST)
    assert evaluation.pairs.images == 1
    assert evaluation.pairs.left_out == {"labels without an image": 1}


def test_splits_of_the_source_are_evaluated_separately(write: Callable[..., Path]) -> None:
    images = [([label(10, 10)], [detect(10 + 10 * k, 10)]) for k in range(4)]
    path = write({"cf1": images}, {"train": "[[0, 2]]", "test": "[[3, 3]]"})
    assert measure(path, Settings(split="test", draws=5))["mean_px"] == 30
    assert measure(path, Settings(split="train", draws=5))["mean_px"] == 10
    with pytest.raises(SettingError, match=r"has no split val\. It has: test, train"):
        run([path], None, Settings(split="val"))


def test_the_threshold_is_the_detectors_unless_one_is_given(write: Callable[..., Path]) -> None:
    path = write({"cf1": [([label(10, 10)], [detect(10, 10, 0.5)])]}, threshold=0.6)
    assert measure(path)["recall"] == 0
    assert measure(path, Settings(threshold=0.5, draws=5))["recall"] == 1


def test_false_alarms_in_empty_images_are_counted(
    write: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    empty: list[Any] = [([], [detect(10, 10, 0.5), detect(40, 30, 0.4)])] * 2 + [([], [])] * 6
    path = write({"cf1": empty}, threshold=0.45, looked=["truth"])
    made = describe_evaluation([path], run([path], None, FAST))
    assert (made["empty_images"], made["alarmed_images"], made["false_alarms"]) == (8, 2, 0.25)
    app(["evaluate", str(path), "--draws", "5"], result_action="return_value")
    assert "nobody in view: an alarm in 2 of 8 images, 0.250 an image" in capsys.readouterr().out


def test_the_threshold_of_a_rate_of_false_alarms(write: Callable[..., Path]) -> None:
    seen = [([label(10, 10)], [detect(10, 10, 0.6)])] * 12
    quiet: list[Any] = [([], [detect(30, 10, 0.7)]), *[([], [detect(30, 10, 0.5)])] * 39]
    path = write({"cf1": [*seen, *quiet]}, looked=["truth"])
    settings = Settings(draws=20, false_alarms=0.05)
    judged = run([path], None, settings)
    assert isinstance(judged, Evaluation)
    assert judged.threshold == pytest.approx(0.55)
    few = write({"cf1": [*seen, *quiet[:5]]}, looked=["truth"], name="few.mcap")
    with pytest.raises(SettingError, match=r"there are 12 and 5\. Give --threshold"):
        run([few], None, settings)
    with pytest.raises(SettingError, match="cannot be combined"):
        run([path], None, Settings(threshold=0.5, false_alarms=0.05))


def test_missing_labels_or_detections_are_reported(write: Callable[..., Path], dots: Path) -> None:
    path = write({"cf1": [([label(10, 10, source="hand")], [detect(10, 10)])]})
    with pytest.raises(SettingError, match=r"no labels from truth\. Give --against one of: hand"):
        run([path], None, FAST)
    with pytest.raises(RecordingError, match=r"has no detections\. Try: dmrl predict MODEL"):
        run([dots], None, FAST)


def test_labels_and_detections_at_different_times_are_not_matched(
    write: Callable[..., Path],
) -> None:
    path = write({"cf1": [([label(10, 10)], None), (None, [detect(10, 10)])]})
    assert measure(path)["recall"] == 0
    with pytest.raises(SettingError, match="has no image with labels from truth and detections"):
        run([path], None, Settings(draws=20, partial=True))


def test_the_json_document_is_complete_and_clean(
    dots: Path, model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    predict.run(model, dots, tmp_path / "out.mcap", predict.Settings())
    words = ["evaluate", str(tmp_path / "out.mcap"), "--split", "test", "--json", "--draws", "9"]
    app(words, result_action="return_value")
    output = json.loads(capsys.readouterr().out)
    assert output["images"] == output["labels"] == output["overall"]["labels"] == 10
    assert (output["against"], output["split"], output["threshold"]) == ("truth", "test", 0.4)
    assert output["recording"]["name"] == "out.mcap"
    assert [band["from_m"] for band in output["bands"]] == [0.0, 0.5, 1.0, 1.5, 2.0]
    assert output["bands"][-1]["to_m"] is None
    assert output["bands"][0]["median_px"] == {"value": None, "low": None, "high": None}
    assert set(output["definitions"]) >= {
        n for n, v in output["overall"].items() if type(v) is dict
    }


def test_the_table_has_a_column_for_each_band_with_labels(
    dots: Path, model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    predict.run(model, dots, tmp_path / "out.mcap", predict.Settings())
    evaluate.command([tmp_path / "out.mcap"], settings=FAST)
    text = " ".join(capsys.readouterr().out.split())  # a long path wraps the line
    assert "30 images against truth" in text
    assert "1 to 1.5 m" in text
    assert "0.5 to 1 m" not in text


@pytest.fixture(scope="module")
def published_detections(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the detections of the published weights on the published set."""
    folder = tmp_path_factory.mktemp("published")
    convert.run(data / "locanet-synthetic", folder / "in.mcap", convert.Settings())
    weights = data / "locanet-weights" / "synthetic.h5"
    predict.run(weights, folder / "in.mcap", folder / "out.mcap", predict.Settings())
    return folder / "out.mcap"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("against", "wanted"),
    [
        ("published", {"within_20_px": 0.776, "within_8_px": 0.673, "median_px": 4.30}),
        ("truth", {"within_20_px": 0.704, "within_8_px": 0.122, "median_px": 11.6}),
    ],
)
def test_published_weights_have_the_published_figures(
    published_detections: Path, against: Any, wanted: dict[str, float]
) -> None:
    got = measure(published_detections, Settings(against=against, split="test", draws=5))
    assert got["labels"] == 98
    for name in ("within_20_px", "within_8_px"):
        assert got[name] == pytest.approx(wanted[name], abs=0.002)
    assert got["median_px"] == pytest.approx(wanted["median_px"], abs=0.05)
    assert [got["depth_mae_m"], got["depth_rmse_m"]] == pytest.approx([0.275, 0.362], abs=0.002)
    if against == "published":
        assert got["f1"] == pytest.approx(0.634, abs=0.02)
        assert got["ap_16_px"] == pytest.approx(0.681, abs=0.05)
