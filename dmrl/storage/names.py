"""Which names are of files elsewhere; nothing is loaded for those that are not."""

from pathlib import Path

SCHEMES = ("s3", "gs", "gcs", "az", "abfs", "http", "https")
"""What a name begins with, before ``://``."""


def path_of(name: str) -> Path:
    """The path that a name stands for: of ``s3://bucket/key`` a `Remote`, else a plain one."""
    scheme, mark, _ = name.partition("://")
    if not mark or scheme not in SCHEMES:
        return Path(name)
    from dmrl.storage.remote import Remote  # noqa: PLC0415 - fsspec, which few need

    return Remote(name)
