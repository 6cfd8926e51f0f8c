"""Reading and writing files so that nothing is lost, half-written or trusted too far.

Every output is written beside its place and renamed onto it. Every input that may come from a stranger is read with
limits on its size, without pickles, and fails with one line that names the file.
"""

from splashbench.files.arrays import MAX_NPZ_BYTES, compressed_bytes, read_npz, write_npz
from splashbench.files.atomic import (
    NO_ROOM,
    as_asked,
    atomic_directory,
    atomic_path,
    files_together,
    is_staged_for,
    raise_if_disk_full,
    remove_any,
    write_text,
)
from splashbench.files.contents import Listing, list_files, sha256_file, tree_bytes
from splashbench.files.documents import (
    MAX_JSON_BYTES,
    MAX_NESTING,
    read_document,
    read_json,
    read_model,
    validate_model,
    write_json,
    write_model,
)
from splashbench.files.images import (
    MAX_PIXELS,
    image_size,
    jpeg_bytes,
    read_gray,
    read_image,
    read_png,
    read_rgba,
    require_png,
    write_image,
    write_png,
)
from splashbench.files.places import (
    require_file_place,
    require_folder_place,
    require_picture_place,
    require_unsealed_place,
)
from splashbench.files.plain import MAX_FILE_BYTES, is_plain_file, open_plain, read_plain, require_plain_file

__all__ = [
    "MAX_FILE_BYTES",
    "MAX_JSON_BYTES",
    "MAX_NESTING",
    "MAX_NPZ_BYTES",
    "MAX_PIXELS",
    "NO_ROOM",
    "Listing",
    "as_asked",
    "atomic_directory",
    "atomic_path",
    "compressed_bytes",
    "files_together",
    "image_size",
    "is_plain_file",
    "is_staged_for",
    "jpeg_bytes",
    "list_files",
    "open_plain",
    "raise_if_disk_full",
    "read_document",
    "read_gray",
    "read_image",
    "read_json",
    "read_model",
    "read_npz",
    "read_plain",
    "read_png",
    "read_rgba",
    "remove_any",
    "require_file_place",
    "require_folder_place",
    "require_picture_place",
    "require_plain_file",
    "require_png",
    "require_unsealed_place",
    "sha256_file",
    "tree_bytes",
    "validate_model",
    "write_image",
    "write_json",
    "write_model",
    "write_npz",
    "write_png",
    "write_text",
]
