"""Start the command line, ``dmrl`` or ``python -m dmrl``, with signals handled from the start."""

from typing import NoReturn

from dmrl.terminal.signals import end_on_signal


def main() -> NoReturn:
    """Run a command; a signal while its packages are imported ends it with one line."""
    end_on_signal()
    from dmrl import cli  # noqa: PLC0415 - it takes 0.1 s, in which a signal may come

    cli.main()


if __name__ == "__main__":
    main()
