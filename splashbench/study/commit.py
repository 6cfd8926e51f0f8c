"""Taking what an attempt at a run has made: every run counts once, whatever is killed and whenever.

Attempts write into folders of their own. Only the process that holds the study's lock moves files out of them, each by
one rename, and the entry last. Where that is killed on the way, the next one finds the attempt with its entry and goes
on. An attempt without an entry was killed itself, and goes.
"""

from __future__ import annotations

import shutil
import uuid
from pathlib import Path

from splashbench.errors import SplashbenchError
from splashbench.files import read_model, write_model
from splashbench.study.job import Attempt, Job, RunEntry, Store


def new_attempt(store: Store, digest: str) -> Path:
    """The folder of another attempt at the run `digest`, which does not exist yet."""
    return store.attempts / f"{digest[:16]}-{uuid.uuid4().hex[:8]}"


def commit(store: Store, attempt: Attempt) -> RunEntry:
    """Let the attempt count as its run, and remove all attempts at that run. May be repeated where it was cut off."""
    entry, job = read_model(attempt.entry, RunEntry), read_model(attempt.request, Job)
    for source, target in ((attempt.results, store.results), (attempt.pictures, store.pictures)):
        for path in sorted(source.glob("*")):
            target.mkdir(parents=True, exist_ok=True)
            path.replace(target / path.name)
    place = store.reference_path(job.digest) if job.is_reference else store.submissions / job.title
    store.submissions.mkdir(parents=True, exist_ok=True)
    if attempt.submission.is_dir():
        shutil.rmtree(place, ignore_errors=True)
        place.parent.mkdir(parents=True, exist_ok=True)
        attempt.submission.rename(place)
    earlier = store.entry(job.digest)
    for stale in {earlier.result, earlier.faded} - {entry.result, entry.faded, None} if earlier else ():
        (store.results / str(stale)).unlink(missing_ok=True)
    write_model(store.entry_path(job.digest), entry)
    remove_attempts(store, job.digest)
    return entry


def commit_failure(store: Store, entry: RunEntry) -> RunEntry:
    """Let `entry` count as its run, of which no attempt came to its end."""
    write_model(store.entry_path(entry.digest), entry)
    remove_attempts(store, entry.digest)
    return entry


def remove_attempts(store: Store, digest: str) -> None:
    """Remove all attempts at the run `digest`; the log of the last one stays."""
    for folder in store.attempts.glob(f"{digest[:16]}-*"):
        log = Attempt(folder).log
        if log.is_file():
            log.replace(store.attempts / f"{digest[:16]}.log")
        shutil.rmtree(folder, ignore_errors=True)


def recover(store: Store) -> None:
    """Take what attempts had made when the study was killed, and remove what they had not."""
    for folder in sorted(path for path in store.attempts.glob("*-*") if path.is_dir()):
        attempt = Attempt(folder)
        try:
            entry = read_model(attempt.entry, RunEntry)
            known = store.entry(entry.digest)
            # Of two attempts that came to their end the first one counts.
            if known is None or known.status != "ok" or known.attempt == entry.attempt:
                commit(store, attempt)
        except SplashbenchError:
            pass
        shutil.rmtree(folder, ignore_errors=True)
