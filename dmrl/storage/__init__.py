"""Read files in a bucket by byte ranges, and upload outputs atomically.

`to_path` turns a name such as ``s3://bucket/a.mcap`` into a `RemotePath`, which has the interface
of `pathlib.Path`. A library that opens it by name gets a local copy.
"""

from dmrl.storage.remote import SCHEMES, RemotePath, to_path
from dmrl.storage.upload import upload_file, upload_folder, upload_into_folder

__all__ = ["SCHEMES", "RemotePath", "to_path", "upload_file", "upload_folder", "upload_into_folder"]
