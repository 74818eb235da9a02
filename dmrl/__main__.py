"""Start the command line, ``dmrl`` or ``python -m dmrl``, with signals handled from the start."""

import os


def main() -> None:
    """Run a command; Ctrl-C while its packages are imported ends it with one line.

    Nothing is imported before that.
    """
    try:
        from dmrl.terminal.signals import end_on_signal  # noqa: PLC0415

        end_on_signal()
        from dmrl import cli  # noqa: PLC0415 - it takes 0.1 s
    except KeyboardInterrupt:
        os.write(
            2, b"dmrl: stopped. No new output has its final name; earlier ones are unchanged\n"
        )
        os._exit(130)
    cli.main()


if __name__ == "__main__":
    main()
