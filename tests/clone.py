"""A copy of the sources, to which a test adds code."""

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
ALL_OF_THEM = """
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
"""Runs one command after the other: what they import is imported once."""


class Clone:
    """A copy of the sources, laid out as they are installed."""

    def __init__(self, root: Path) -> None:
        self.root = root
        # What Python has compiled comes along; what another process is writing does not.
        ignored = shutil.ignore_patterns("*.pyc.*", "pretrained")
        shutil.copytree(ROOT / "dmrl", root / "dmrl", ignore=ignored)
        pretrained = "dmrl/learn/pretrained"
        (root / pretrained).mkdir()
        shutil.copy(ROOT / pretrained / "__init__.py", root / pretrained)
        for name in ("viewer", "schemas", "recipes"):
            shutil.copytree(ROOT / name, root / name, ignore=ignored)
            (root / "dmrl" / name).symlink_to(root / name)
        self._before = self._held()

    def write(self, name: str, text: str) -> None:
        (self.root / name).write_text(textwrap.dedent(text), encoding="utf-8")

    def after(self, name: str, place: str, text: str) -> None:
        """Put text behind a place that a file has once."""
        old = (self.root / name).read_text(encoding="utf-8")
        assert old.count(place) == 1, (name, place)
        (self.root / name).write_text(old.replace(place, place + text), encoding="utf-8")

    def touched(self) -> int:
        """Files written or changed by hand since the copy was made."""
        now = self._held()
        changed = {name for name in now if now[name] != self._before.get(name)}
        return len(changed - GENERATED)

    def _held(self) -> dict[str, bytes]:
        files = (p for p in self.root.rglob("*") if p.is_file() and p.suffix != ".pyc")
        return {str(p.relative_to(self.root)): p.read_bytes() for p in files}

    def python(self, *words: str) -> str:
        """What the copy's Python prints."""
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

    def dmrl(self, *commands: list[str | Path]) -> list[str]:
        """What each of several commands of the copy prints."""
        words = json.dumps([[str(word) for word in command] for command in commands])
        said: list[str] = json.loads(self.python("-c", ALL_OF_THEM, words).splitlines()[-1])
        return said
