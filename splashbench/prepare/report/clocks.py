"""Clocks and recordings in the report: offsets and drifts, the windows behind them, the sound's travel, the files."""

from __future__ import annotations

import numpy as np

from splashbench.pages.blocks import Block, Note, Table
from splashbench.prepare.preparation import Preparation
from splashbench.prepare.report.pictures import SWEEP_COLOUR, TRAIN_COLOUR, chart


def clocks_section(preparation: Preparation) -> list[Block]:
    """A table of the clocks, the windows they were fitted to, and the sound's travel."""
    offsets = preparation.sequence.offsets_s
    rows = [
        [
            camera,
            f"{fit.start_s:.6f}",
            f"{(fit.clock_rate - 1) * 1e6:+.1f} ± {fit.drift_interval * 1e6:.1f}",
            f"{fit.interval_s * 1e3:.2f}",
            "reference" if camera == preparation.session.reference else f"{fit.confidence:.1f}",
            f"{fit.residual_rms_s * 1e6:.0f}",
            f"{fit.n_windows}, {fit.agreement:.0%}" if fit.n_windows else "",
            f"{fit.echo_s * 1e3:+.1f}" if fit.echo_s else "none",
            f"{offsets[camera] * 1e3:+.2f}" if camera in offsets else "unknown",
        ]
        for camera, fit in preparation.clocks.items()
    ]
    header = [
        "camera",
        "start [s]",
        "drift [us/s]",
        "known to [ms]",
        "confidence",
        "scatter [us]",
        "windows, agreeing",
        "earlier sound [ms]",
        "residual in the sequence [ms]",
    ]
    note = (
        "Reference time = start + (1 + drift) x local time. The true drift lies within its interval with 95 %, and the"
        " true clock within what it is known to, at the worst moment that both cameras record. A drift of +0.0 is one"
        " that the sound was too short to tell from none. Confidence: how many times better the sound matches at this"
        " offset than at any other. Earlier sound: a weaker copy precedes the sound that the clock follows, so it is"
        " a reflection; positive in this camera, negative in the reference. Residual in the sequence: the offset from"
        f" the clock, measured again within the motion interval, less the mean over cameras{_both(preparation)}. Below:"
        " every window of sound that a clock was fitted to, by its delay from the clock's line. The scatter is that of"
        " all windows with one clear peak. A bend would be a clock whose rate changed."
    )
    return [
        Table(header, rows),
        Note(note),
        *_windows(preparation),
        *_sound_paths(preparation),
    ]


def _both(preparation: Preparation) -> str:
    """The RMS of the residuals, and the paper's Sync RMS."""
    sequence = preparation.sequence
    if sequence.clock_rms_s is None or sequence.whole_frame_rms_s is None:
        return ""
    return (
        f"; their RMS is {sequence.clock_rms_s * 1e3:.2f} ms. Had each camera been shifted once, by whole frames, it"
        f" would be {sequence.whole_frame_rms_s * 1e3:.2f} ms: the paper's Sync RMS, which holds rounding and drift"
    )


def _windows(preparation: Preparation) -> list[Block]:
    """Where the windows' delays lie about every camera's clock."""
    from matplotlib.figure import Figure

    fitted = {camera: fit for camera, fit in preparation.clocks.items() if fit.windows}
    if not fitted:
        return []
    columns = min(3, len(fitted))
    rows = -(-len(fitted) // columns)
    figure = Figure(figsize=(9, 1.9 * rows), layout="constrained")
    for index, (camera, fit) in enumerate(fitted.items()):
        axes = figure.add_subplot(rows, columns, index + 1)
        times, residuals = np.array(fit.windows).T
        axes.axhline(0, color=SWEEP_COLOUR, linewidth=0.8)
        axes.plot(times, residuals * 1e6, ".", color=TRAIN_COLOUR, markersize=3)
        axes.set_title(f"camera {camera}", fontsize=9)
        axes.set(xlabel="local time [s]", ylabel="delay [us]")
        axes.tick_params(labelsize=8)
    return [chart(figure, "the windows' delays from each camera's clock")]


def _sound_paths(preparation: Preparation) -> list[Block]:
    paths = preparation.sound_paths
    rows = [
        [camera, f"{paths.distance_m[camera]:.2f}", f"{paths.shift_s[camera] * 1e3:+.2f}"]
        for camera in paths.distance_m
    ]
    place = "({:.2f}, {:.2f}, {:.2f}) m".format(*paths.source)
    if paths.applied:
        note = f"The sound came from {place}. The clocks above are corrected for its travel."
    else:
        note = (
            "The clocks above go by the sound's arrival. Had it come from the scene's origin, its travel would shift"
            " them as below. To correct for it, give [sound] source in session.toml."
        )
    header = ["camera", "path of the sound [m]", "shift of the clock [ms]"]
    return [Note(note), Table(header, rows)]


def recordings_section(preparation: Preparation) -> list[Block]:
    """A table of the recordings of the pour."""
    rows = []
    for camera, video in preparation.synced.videos.items():
        longer = video.audio_minus_video_s
        seams = preparation.synced.seams[camera]
        rows.append(
            [
                camera,
                f"{video.width}x{video.height}",
                f"{video.fps:.3f}",
                str(video.n_frames),
                f"{video.duration:.2f}",
                video.codec,
                video.timecode or "none",
                "unknown" if longer is None else f"{longer * 1e3:+.2f}",
                ", ".join(f"{seam.gap_s * 1e3:+.1f} ms at {seam.time_s:.1f} s" for seam in seams) or "none",
            ]
        )
    header = [
        "camera",
        "size",
        "fps",
        "frames",
        "seconds",
        "codec",
        "timecode",
        "sound - video [ms]",
        "gaps in the sound",
    ]
    return [Table(header, rows)]
