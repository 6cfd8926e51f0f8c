"""The user's cache folder: what was fetched once, such as the weights of LPIPS, stays there."""

from __future__ import annotations

import os
from pathlib import Path

from splashbench.errors import SplashbenchError

CACHE_VARIABLE = "SPLASHBENCH_CACHE"


def cache_folder() -> Path:
    """The folder, which need not exist: SPLASHBENCH_CACHE, else `splashbench` in XDG_CACHE_HOME, else in ~/.cache.

    Raises SplashbenchError for a user without a home folder.
    """
    if chosen := os.environ.get(CACHE_VARIABLE):
        return Path(chosen)
    caches = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if not caches.is_absolute():  # the XDG Base Directory Specification asks to ignore it then
        try:
            caches = Path.home() / ".cache"
        except RuntimeError:
            raise SplashbenchError(
                f"there is no home folder to keep a cache in; name a folder by the variable {CACHE_VARIABLE}"
            ) from None
    return caches / "splashbench"
