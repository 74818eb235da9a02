"""Build ``dmrl.binpb`` from the .proto files and foxglove's descriptors.

Run as ``python schemas/build.py [OUT]`` or ``make schemas``. This is a developer's tool: the
package reads the committed result and needs neither protoc nor foxglove's classes.
"""

import sys
import tempfile
from importlib import import_module
from pathlib import Path

from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from grpc_tools import protoc

SCHEMA_FOLDER = Path(__file__).parent
FOXGLOVE = ("CameraCalibration", "CompressedImage", "FrameTransforms", "Log", "PoseInFrame")


def compile_own_files() -> list[FileDescriptorProto]:
    """Compile dmrl/v1/*.proto with protoc and return their descriptors."""
    protos = sorted(
        str(p.relative_to(SCHEMA_FOLDER)) for p in SCHEMA_FOLDER.glob("dmrl/v1/*.proto")
    )
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "own.binpb"
        if (
            protoc.main(["protoc", f"-I{SCHEMA_FOLDER}", f"--descriptor_set_out={out}", *protos])
            != 0
        ):
            raise SystemExit("protoc rejected the schemas, see above")
        return list(FileDescriptorSet.FromString(out.read_bytes()).file)


def add_dependencies(file: FileDescriptor, found: dict[str, FileDescriptorProto]) -> None:
    """Add ``file`` and everything it imports to ``found``, imports first."""
    for dependency in file.dependencies:
        add_dependencies(dependency, found)
    proto = FileDescriptorProto()
    file.CopyToProto(proto)
    found.setdefault(file.name, proto)


def build_descriptor_set() -> bytes:
    """Build the serialized FileDescriptorSet, in a fixed order."""
    found: dict[str, FileDescriptorProto] = {}
    for name in FOXGLOVE:
        add_dependencies(import_module(f"foxglove_schemas_protobuf.{name}_pb2").DESCRIPTOR, found)
    files = [*found.values(), *compile_own_files()]
    done: set[str] = set()
    ordered = FileDescriptorSet()

    def add_file(file: FileDescriptorProto) -> None:
        if file.name in done:
            return
        done.add(file.name)
        for dependency in file.dependency:
            add_file(by_name[dependency])
        ordered.file.append(file)

    by_name = {f.name: f for f in files}
    for file in files:
        add_file(file)
    return ordered.SerializeToString(deterministic=True)


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else SCHEMA_FOLDER / "dmrl.binpb"
    target.write_bytes(build_descriptor_set())
