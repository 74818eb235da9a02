"""Read files in a bucket by byte ranges, and upload outputs atomically.

`to_path` turns a name such as ``s3://bucket/a.mcap`` into a `RemotePath`, which has the interface
of `pathlib.Path`. A library that opens it by name gets a local copy.
"""

from dmrl.storage.remote import SCHEMES, Remote, path_of
from dmrl.storage.upload import added_files, uploaded_file, uploaded_folder

__all__ = ["SCHEMES", "Remote", "added_files", "path_of", "uploaded_file", "uploaded_folder"]
