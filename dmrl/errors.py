"""Define the errors that a user can act on. Each message is one line and ends with a way out.

* DmrlError
  - OutputError       the output exists, cannot be written, or is another process's
    + BusyOutput
    + FullDisk
  - UnsafeName        a name from a file cannot become a path
  - RecordingError    the file cannot be read, or lacks requested data
    + MissingTopic
    + UnreadableTopic
  - SourceError       a foreign file or folder does not conform to its format
    + EmptySource
  - DatasetError      a folder is not a dataset, or lacks requested data
    + MissingSplit
  - ModelError        weights or a run folder cannot be used
  - RecipeError       the TOML does not describe a run
  - SettingError      a setting does not fit the input
  - BlenderError      Blender cannot be set up, does not start, or cannot use a model
  - ToolError         a compiler or an emulator is missing, or fails
  - StorageError      a bucket or its server cannot be reached, or refuses
  - ClusterError      a cluster does not answer, or its nodes differ in version
  - MissingExtra      a package from an extra is not installed
  - PluginError       a plug-in of another package does not work
"""

import unicodedata
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches


def suggest(wrong: str, known: Iterable[str], otherwise: str) -> str:
    """Return "Did you mean ...?" with the known name nearest to a wrong one, or other words."""
    near = get_close_matches(wrong, sorted(known), n=1, cutoff=0.55)  # two of three letters right
    return f"Did you mean {near[0]}?" if near else otherwise


def to_one_line(text: str) -> str:
    r"""Return the text in one line: control characters as ``\x1b``, line ends as spaces.

    Characters that control a terminal or the direction of text are escaped.
    """
    return "".join(map(_escape_character, " ".join(text.splitlines())))


def _escape_character(character: str) -> str:
    if unicodedata.category(character) in ("Cc", "Cf", "Cs", "Zl", "Zp"):
        return character.encode("unicode_escape", "surrogatepass").decode("ascii")
    return character


def describe_error(error: Exception) -> str | None:
    """Return the message for an error of the user, disk or machine; None for a bug."""
    match error:
        case DmrlError():
            return str(error)
        case UnicodeEncodeError():
            return f"{ascii(error.object)[:80]} cannot be stored as UTF-8. Rename the file"
        case MemoryError():
            kind = f"{type(error).__name__}: {str(error)[:200]}".rstrip(": ")
            return f"this machine has not enough memory ({kind}). Use less data at once"
        case OSError(errno=int()):
            named = error.filename
            where = "standard output, or a disk" if named is None else str(named)
            why = f"cannot read or write {where}: {error.strerror}"
            return f"{why}. Check its name, permissions and free space"
        case RuntimeError() if str(error).startswith("Symlink loop"):  # Python before 3.13
            return f"cannot read a link that points to itself: {error}. Remove it"
    return None


class DmrlError(Exception):
    """Base of every error that ``dmrl`` prints without a traceback."""

    def __str__(self) -> str:
        """Return one line, whatever the names and library messages in it contain."""
        return to_one_line(super().__str__())


class OutputError(DmrlError):
    """An output exists, cannot be written, or is being written by another process."""


class BusyOutput(OutputError):
    """Another process is writing the output."""


class FullDisk(OutputError):
    """The disk of the output is full."""


class UnsafeName(DmrlError):
    """A name from a file cannot be used as a file name."""


class RecordingError(DmrlError):
    """A recording cannot be read, or lacks requested data."""


REMEDIES = {
    "/labels": "Label it with dmrl label, or by hand: dmrl view {where} --flag desk.html",
    "/detections": "Try: dmrl predict MODEL {where} OUT.mcap",
    "/position": "Try: dmrl label {where} OUT.mcap",
    "/camera/calibration": "Give the camera to dmrl convert: --camera FILE",
    "/attitude": "Merge the log of the robot with it: dmrl merge {where} LOG.mcap OUT.mcap",
}
"""How to get the content of a topic, by the end of its name."""


class MissingTopic(RecordingError):
    """A recording lacks a topic that a stage reads.

    The message says how to get its content or, where that is unknown, suggests a similar topic.

    Parameters
    ----------
    topic
        The requested topic or pattern.
    present
        Topics of the recording.
    where
        The recording.
    """

    def __init__(self, topic: str, present: Iterable[str], where: object) -> None:
        near = get_close_matches(topic, held := sorted(present), n=1)
        end = next((end for end in REMEDIES if topic.endswith(end)), "")
        remedy = REMEDIES.get(end, "Try: dmrl info {where}").format(where=where)
        hint = remedy if end else suggest(topic, held, remedy)
        if near and topic.startswith("/*/"):  # a stage asks for it, and not the user
            name = f"{near[0]}={topic.replace('*', 'cf1', 1)}"
            hint += f" Rename it: dmrl convert {where} OUT.mcap --names {name}"
        super().__init__(f"no topic {topic} in {where}. {hint}")


class UnreadableTopic(RecordingError):
    """Messages of a topic cannot be decoded, in a sound recording.

    Parameters
    ----------
    where
        The recording.
    topic
        The topic.
    why
        Reason, as the rest of a sentence about the topic.
    """

    def __init__(self, where: object, topic: str, why: str) -> None:
        self.reason = f"messages on {topic}, which {why}"
        super().__init__(
            f"{where}: {topic} {why}. Leave it out (dmrl trim), or convert it: "
            f"dmrl convert {where} OUT.mcap"
        )


class SourceError(DmrlError):
    """A foreign file or folder does not conform to its format."""


class EmptySource(SourceError):
    """A file of its format has no row that can be used."""


class DatasetError(DmrlError):
    """A folder is not a dataset, or lacks requested data."""


class MissingSplit(DatasetError, KeyError):
    """A dataset has no split of this name. Also a KeyError, as of any mapping.

    Parameters
    ----------
    split
        The requested name.
    present
        Splits of the dataset.
    where
        The dataset.
    """

    def __init__(self, split: str, present: Iterable[str], where: object) -> None:
        super().__init__(f"no split {split} in {where}. It has: {', '.join(present)}")

    def __str__(self) -> str:
        """Return the message; a KeyError would quote it."""
        return to_one_line(str(self.args[0]))


class ModelError(DmrlError):
    """Weights or a run folder cannot be used."""


class RecipeError(DmrlError):
    """A recipe does not describe a run."""


class SettingError(DmrlError):
    """A setting does not fit the input."""


class BlenderError(DmrlError):
    """Blender cannot be set up, does not start, or cannot use a model."""


class ToolError(DmrlError):
    """A compiler or an emulator is not installed, or fails."""


class StorageError(DmrlError):
    """A bucket or its server cannot be reached, or refuses."""


class ClusterError(DmrlError):
    """A cluster does not answer, or its nodes have another version of dmrl."""


class MissingExtra(DmrlError):
    """A package from an optional extra is not installed.

    Parameters
    ----------
    package
        Name on PyPI.
    extra
        The extra of dmrl that installs it.
    what
        The command or feature that needs it.
    """

    def __init__(self, package: str, extra: str, what: str) -> None:
        super().__init__(f"{what} needs {package}. Install it with: pip install 'dmrl[{extra}]'")


@contextmanager
def optional_imports(extra: str, what: str) -> Iterator[None]:
    """Raise MissingExtra if a package that is imported in the block is not installed."""
    try:
        yield
    except ModuleNotFoundError as e:
        raise MissingExtra(str(e.name), extra, what) from e


class PluginError(DmrlError):
    """A plug-in of another package cannot be loaded, or fails. The message names the package."""
