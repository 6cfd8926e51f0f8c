"""The recordings of the pour, one per camera, opened once."""

from __future__ import annotations

from functools import cached_property

from splashbench.native.memory import give_back
from splashbench.prepare.session import Session
from splashbench.prepare.stage_cache import FileFacts, facts_of
from splashbench.prepare.video.recording import Recording


class PourRecordings:
    """Every camera's recording of the pour, and the facts that tell its files from earlier ones."""

    def __init__(self, session: Session) -> None:
        self.recordings = {camera: Recording(session.paths("pour", camera)) for camera in session.cameras}

    def files(self, camera: str) -> list[FileFacts]:
        """One camera's files."""
        return facts_of(self.recordings[camera].paths)

    @cached_property
    def all_files(self) -> dict[str, list[FileFacts]]:
        """Camera -> its files."""
        return {camera: self.files(camera) for camera in self.recordings}

    def forget_sound(self) -> None:
        """Hold the sound of no camera any more."""
        for recording in self.recordings.values():
            recording.forget_sound()
        give_back()
