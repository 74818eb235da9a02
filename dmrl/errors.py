"""Errors a user can act on. Every message is one line and ends with the way out.

* DmrlError
  - OutputError       the output exists, cannot be written, or is another process's
    + BusyOutput
    + FullDisk
  - UnsafeName        a name from a file cannot become a path
  - RecordingError    the file cannot be read, or lacks what was asked of it
    + MissingTopic
  - SourceError       a foreign file or folder is not what its format says
  - DatasetError      a folder is not a dataset, or lacks what was asked of it
  - ModelError        weights or a run folder cannot be used
  - RecipeError       the TOML does not describe a run
  - SettingError      a setting cannot be met by this input
  - BlenderError      Blender cannot be set up, does not start, or cannot use a model
  - ToolError         a compiler or an emulator is missing, or fails
  - StorageError      a bucket or its server cannot be reached, or refuses
  - ClusterError      a cluster does not answer, or its nodes are not alike
  - MissingExtra      a package that an optional room needs is not installed
  - PluginError       what another package adds to dmrl does not work
"""

import unicodedata
from collections.abc import Iterable
from difflib import get_close_matches


def one_line(text: str) -> str:
    r"""The text in one line: control characters as ``\x1b``, line ends as spaces.

    What orders a terminal about, or turns a text's direction, is shown and not obeyed.
    """
    return "".join(map(_shown, " ".join(text.splitlines())))


def _shown(character: str) -> str:
    if unicodedata.category(character) in ("Cc", "Cf", "Cs", "Zl", "Zp"):
        return character.encode("unicode_escape", "surrogatepass").decode("ascii")
    return character


def words_of(error: Exception) -> str | None:
    """What is said of an error that is the user's, the disk's or the machine's; None: a bug."""
    match error:
        case DmrlError():
            return str(error)
        case UnicodeEncodeError():
            return f"{ascii(error.object)[:80]} is no text that can be stored. Rename the file"
        case MemoryError():
            kind = f"{type(error).__name__}: {str(error)[:200]}".rstrip(": ")
            return f"this machine has not enough memory ({kind}). Give less at once"
        case OSError(errno=int()):
            named = error.filename
            where = "standard output, or a disk" if named is None else str(named)
            why = f"cannot read or write {where}: {error.strerror}"
            return f"{why}. Check its name, its rights, its space"
        case RuntimeError() if str(error).startswith("Symlink loop"):  # Python before 3.13
            return f"cannot read a link that leads to itself: {error}. Remove it"
    return None


class DmrlError(Exception):
    """Base of every error that ``dmrl`` prints without a traceback."""

    def __str__(self) -> str:
        """One line, whatever names of a file, or words of a library, stand in it."""
        return one_line(super().__str__())


class OutputError(DmrlError):
    """An output exists already, cannot be written, or is being written by another process."""


class BusyOutput(OutputError):
    """Another process is writing the output just now."""


class FullDisk(OutputError):
    """There is no space left where the output was to be written."""


class UnsafeName(DmrlError):
    """A name that stands in a file cannot be the name of a file."""


class RecordingError(DmrlError):
    """A recording cannot be used as asked."""


class MissingTopic(RecordingError):
    """A recording lacks a topic that a stage reads.

    Parameters
    ----------
    topic
        The topic, or pattern of topics, that was wanted.
    present
        Topics the recording has; the nearest is offered.
    where
        The recording.
    """

    def __init__(self, topic: str, present: Iterable[str], where: object) -> None:
        near = get_close_matches(topic, sorted(present), n=1)
        hint = f"Did you mean {near[0]}?" if near else f"Try: dmrl info {where}"
        super().__init__(f"no topic {topic} in {where}. {hint}")


class SourceError(DmrlError):
    """A foreign file or folder is not what its format says."""


class DatasetError(DmrlError):
    """A folder is not a dataset, or lacks what was asked of it."""


class ModelError(DmrlError):
    """Weights or a run folder cannot be used."""


class RecipeError(DmrlError):
    """A recipe does not describe a run."""


class SettingError(DmrlError):
    """A setting cannot be met by this input."""


class BlenderError(DmrlError):
    """Blender cannot be set up, does not start, or cannot use a model."""


class ToolError(DmrlError):
    """A compiler or an emulator is not installed, or cannot do its work."""


class StorageError(DmrlError):
    """A bucket, or the server that has it, cannot be reached, or refuses."""


class ClusterError(DmrlError):
    """A cluster does not answer, or its nodes have another version of dmrl."""


class MissingExtra(DmrlError):
    """A package from an optional extra is not installed.

    Parameters
    ----------
    package
        Name on PyPI.
    extra
        The extra of dmrl that brings it.
    what
        What needs it, as the user knows it.
    """

    def __init__(self, package: str, extra: str, what: str) -> None:
        super().__init__(f"{what} needs {package}. Install it with: pip install 'dmrl[{extra}]'")


class PluginError(DmrlError):
    """What another package adds to dmrl cannot be loaded, or fails; the package is named."""
