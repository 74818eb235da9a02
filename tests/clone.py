"""A copy of the sources that a test may edit and run."""

import json
import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

ROOT = Path(__file__).parents[1]
GENERATED = {"schemas/dmrl.binpb"}
"""What `make schemas` writes."""
RUN_COMMANDS = """
import contextlib, io, json, sys
from dmrl.cli import main
said = []
for words in json.loads(sys.argv[1]):
    sys.argv, out = ["dmrl", *words], io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        try: main()
        except SystemExit as e: assert not e.code, (words, out.getvalue())
    said.append(out.getvalue())
print(json.dumps(said))
"""
"""Program that runs several commands in one process, so that imports are paid once."""


class Clone:
    """A copy of the sources with the layout of an installed package."""

    def __init__(self, root: Path) -> None:
        self.root = root
        # Compiled files are copied to save time. Those with a number behind .pyc are still being
        # written by another process.
        ignored = shutil.ignore_patterns("*.pyc.*", "pretrained")
        shutil.copytree(ROOT / "dmrl", root / "dmrl", ignore=ignored)
        pretrained = "dmrl/learn/pretrained"
        (root / pretrained).mkdir()
        shutil.copy(ROOT / pretrained / "__init__.py", root / pretrained)
        for name in ("viewer", "schemas", "recipes"):
            shutil.copytree(ROOT / name, root / name, ignore=ignored)
            (root / "dmrl" / name).symlink_to(root / name)
        self._before = self._read_files()

    def write(self, name: str, text: str) -> None:
        """Write a file of the copy, with the common indentation of the text removed."""
        (self.root / name).write_text(textwrap.dedent(text), encoding="utf-8")

    def insert_after(self, name: str, place: str, text: str) -> None:
        """Insert text after a string that occurs once in a file."""
        old = (self.root / name).read_text(encoding="utf-8")
        assert old.count(place) == 1, (name, place)
        (self.root / name).write_text(old.replace(place, place + text), encoding="utf-8")

    def count_edited_files(self) -> int:
        """Return the number of files written since the copy was made, without generated ones."""
        now = self._read_files()
        changed = {name for name in now if now[name] != self._before.get(name)}
        return len(changed - GENERATED)

    def _read_files(self) -> dict[str, bytes]:
        """Return the content of every file by its relative path, without compiled ones."""
        files = (p for p in self.root.rglob("*") if p.is_file() and p.suffix != ".pyc")
        return {str(p.relative_to(self.root)): p.read_bytes() for p in files}

    def run_python(self, *words: str) -> str:
        """Run Python with the copy on its path; return standard output and standard error."""
        environment = {**os.environ, "PYTHONPATH": str(self.root)}
        done = subprocess.run(
            [sys.executable, *words],
            cwd=self.root.parent,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout + done.stderr

    def run_dmrl(self, *commands: list[str | Path]) -> list[str]:
        """Run commands of the copy in one process; return what each of them prints."""
        words = json.dumps([[str(word) for word in command] for command in commands])
        said: list[str] = json.loads(self.run_python("-c", RUN_COMMANDS, words).splitlines()[-1])
        return said
