"""Memory and operations of untrusted ONNX files are checked before onnxruntime loads them."""

import pytest

from dmrl.errors import ModelError

onnx = pytest.importorskip("onnx")
from onnx import TensorProto, helper  # noqa: E402

from dmrl.deploy.onnx.static_check import require_modest  # noqa: E402


def build_onnx(*nodes: object, sides: tuple[int, ...] = (4,), image: object = 224) -> bytes:
    """Return the bytes of a network that returns its image, with further nodes."""
    shape = ["N", image, 320, 3]
    made = helper.make_graph(
        [helper.make_node("Identity", ["image"], ["confidence_logit"]), *nodes],
        "network",
        [helper.make_tensor_value_info("image", TensorProto.UINT8, shape)],
        [helper.make_tensor_value_info("confidence_logit", TensorProto.UINT8, shape)],
        [helper.make_tensor("sides", TensorProto.INT64, [len(sides)], list(sides))],
    )
    opsets = [helper.make_opsetid("", 17)]
    data: bytes = helper.make_model(made, opset_imports=opsets).SerializeToString()
    return data


def build_node(kind: str, inputs: tuple[str, ...], output: str, **more: object) -> object:
    """Return a node of an ONNX graph with one output."""
    return helper.make_node(kind, list(inputs), [output], **more)


MANY = build_node("ConstantOfShape", ("sides",), "many")
BODY = helper.make_graph([], "body", [], [])


def test_valid_onnx_network_passes_the_static_check() -> None:
    require_modest(build_onnx(), "a.onnx")
    require_modest(build_onnx(MANY, sides=(1_000, 1_000)), "a.onnx")


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (build_onnx(MANY, sides=(1 << 30,)), "ConstantOfShape makes 4295 MB"),
        (
            build_onnx(MANY, build_node("MatMul", ("many", "many"), "more"), sides=(6_000, 6_000)),
            "MatMul makes .* 216 billion products",
        ),
        (
            build_onnx(
                build_node("Tile", ("image", "times"), "more"),
                build_node("Shape", ("image",), "times"),
            ),
            "a.onnx cannot be run",
        ),
        (build_onnx(build_node("Loop", ("sides",), "more", body=BODY)), "Loop runs another graph"),
        (
            build_onnx(build_node("If", ("sides",), "more", then_branch=BODY)),
            "If runs another graph",
        ),
        (build_onnx(build_node("Scan", ("sides",), "more", body=BODY)), "Scan runs another graph"),
        (
            build_onnx(build_node("Gelu", ("image",), "more", domain="com.x")),
            "Gelu is no standard operator",
        ),
        (build_onnx(image="H"), "the size of image is not known"),
        (build_onnx(build_node("NonZero", ("image",), "more")), "the size of more is not known"),
        (b"no network", "a.onnx cannot be run"),
    ],
)
def test_oversized_onnx_file_gives_one_line_error(data: bytes, said: str) -> None:
    with pytest.raises(ModelError, match=said) as e:
        require_modest(data, "a.onnx")
    assert str(e.value).startswith("a.onnx cannot be run: ") and "\n" not in str(e.value)


def test_constants_in_other_files_are_not_read() -> None:
    model = onnx.load_model_from_string(build_onnx())
    constant = model.graph.initializer[0]
    constant.data_location = TensorProto.EXTERNAL
    constant.external_data.add(key="location", value="/etc/passwd")
    with pytest.raises(ModelError, match="its constants are in other files"):
        require_modest(model.SerializeToString(), "a.onnx")
