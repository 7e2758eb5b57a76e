"""Point-cloud files -> points, for the service and for its client. numpy only; knows no cloud processing and no HTTP.

A file may be hostile: every size that its header claims is compared with the bytes that are there and with the caller's
limit before anything of that size is allocated or expanded.
"""

from tesnet.formats.pcd import is_pcd, read_pcd, seen
from tesnet.formats.ply import is_ply, read_ply

__all__ = ["is_pcd", "is_ply", "read_pcd", "read_ply", "seen"]
