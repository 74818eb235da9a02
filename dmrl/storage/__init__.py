"""Files that lie in a bucket: read by ranges, written whole or not at all.

`path_of` makes a path of what a user names: of ``s3://bucket/a.mcap`` a `Remote`, which answers
as a path does. Who opens one by its name, as a library does, gets a copy on this machine.
"""

from dmrl.storage.remote import SCHEMES, Remote, path_of
from dmrl.storage.upload import added_files, uploaded_file, uploaded_folder

__all__ = ["SCHEMES", "Remote", "added_files", "path_of", "uploaded_file", "uploaded_folder"]
