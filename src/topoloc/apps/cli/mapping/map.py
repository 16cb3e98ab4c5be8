"""topoloc map SOURCE MAP"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import tyro

from topoloc import (
    BuildConfig,
    GrowingMap,
    RecordingError,
    StereoSequence,
    TopolocError,
    open_sequence,
)
from topoloc.apps.cli.features_option import BUILD_FEATURES, select_build_features
from topoloc.apps.cli.maps.level import find_and_move
from topoloc.apps.cli.output import (
    CameraOption,
    File,
    Flag,
    Format,
    MaskOption,
    Topics,
    UsageError,
    catch_stop_signals,
    check_outputs,
    describe_recording,
    open_recording,
    print_line,
    write_json,
)
from topoloc.apps.cli.settings_file import read_settings


@dataclass(frozen=True)
class Command:
    """Arguments of `topoloc map`."""

    source: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SEQ")]
    """A stereo or RGB-D recording; with --live one that `topoloc record` is writing."""
    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP")]
    """The new map file. It is whole after each piece, also if this process is killed."""
    live: Flag = False
    """Wait for further frames, until none came for --idle seconds."""
    idle: Annotated[float, tyro.conf.arg(metavar="SECONDS")] = 10.0
    """With --live, seconds without a new frame after which the recording has ended."""
    realtime: Flag = False
    """Replay a recording at the speed at which it was made."""
    piece: Annotated[int, tyro.conf.arg(metavar="FRAMES")] = 100
    """Frames after which the map is extended and written, at least."""
    level: Flag = False
    """At the end, give the map a world with z up and the floor at z = 0, see `topoloc level`."""
    format: Format = None
    camera: CameraOption = None
    mask: MaskOption = None
    topics: Topics = None
    features: BUILD_FEATURES = None
    """Feature types of the map. `learned`: the first network of `topoloc weights list` that is
    installed. `both`: that and SURF."""
    json: File = None
    """Write the facts of the map as JSON (- for standard output)."""
    config: File = None
    """TOML file with all other settings, see `topoloc config build`."""

    def run(self) -> int:
        if self.live and self.realtime:
            raise UsageError("--live and --realtime exclude each other: one waits for a camera")
        if self.piece < 20:
            raise UsageError(f"--piece {self.piece}: at least 20 frames show a motion")
        if not self.idle > 0.0:
            raise UsageError(f"--idle {self.idle:g}: seconds above 0 are needed")
        check_outputs([self.map, self.json], [self.source, self.mask])
        config = read_settings(self.config).get(BuildConfig)
        growing = GrowingMap(self.map, select_build_features(config, self.features))
        num_frames, num_lost, began = 0, 0, time.monotonic()
        with catch_stop_signals() as stop:
            for sequence, num_frames in self._pieces(stop):
                growth = growing.add(sequence, num_frames)
                num_lost += growth.num_frames - growth.num_posed
                if self.json != "-":
                    rate = growth.num_frames / growth.seconds
                    print_line(
                        f"{num_frames} frames, {num_lost} without a pose: {growth.num_nodes} nodes,"
                        f" {growth.length_m:.1f} m, {rate:.1f} frames/s"
                    )
        topomap = growing.finish()
        if topomap is None:
            raise RecordingError(f"{self.source}: no piece of it could be mapped: {growing.fault}")
        facts = topomap.describe(self.map) | {
            "num_frames": num_frames,
            "num_lost": num_lost,
            "max_shift_m": growing.max_shift_m,
            "frames_per_second": round(num_frames / (time.monotonic() - began), 2),
        }
        if self.json != "-":
            size = f"{facts['num_nodes']} nodes, {facts['num_points']} points"
            print_line(
                f"{self.map}: {size}, {facts['bytes'] / 1e6:.2f} MB, {facts['length_m']:.1f} m"
                f" mapped, pieces moved by at most {growing.max_shift_m:.3f} m"
            )
        growing.close()
        write_json(self.json, facts)
        if self.level:
            find_and_move(self.map)
        return 0

    def _pieces(self, stop: threading.Event) -> Iterator[tuple[StereoSequence, int]]:
        """Yield the recording and the number of its frames up to the end of the next piece."""
        words = self.source, self.format, self.camera, self.topics
        sequence = self._open(stop) if self.live else open_recording(*words, mask=self.mask)
        if self.json != "-":
            print_line(describe_recording(*words[:3], sequence))
        done, began = 0, time.monotonic()
        last = began
        while not stop.is_set():
            ready = self._num_ready(sequence, began)
            is_ended = ready == len(sequence) and (
                not self.live or time.monotonic() - last > self.idle
            )
            if ready - done >= self.piece or (is_ended and ready > done):
                end = ready if self.live or self.realtime else done + self.piece
                end = end if ready - end >= self.piece else ready  # no short last piece
                yield sequence, end
                done, last = end, time.monotonic()
            elif is_ended:
                return
            else:
                time.sleep(0.2)
            if self.live and len(more := self._reopen(sequence)) > len(sequence):
                sequence, last = more, time.monotonic()

    def _num_ready(self, sequence: StereoSequence, began: float) -> int:
        """Return how many frames a camera would have taken by now."""
        if not self.realtime:
            return len(sequence)
        t_ns = sequence.t_ns
        now = t_ns[0] + 1e9 * (time.monotonic() - began)
        return sum(one <= now for one in t_ns)

    def _open(self, stop: threading.Event) -> StereoSequence:
        """Open a recording that may not have a frame yet. Raises RecordingError."""
        began = time.monotonic()
        while True:
            try:
                return self._open_now()
            except TopolocError:
                if stop.is_set() or time.monotonic() - began > self.idle:
                    raise
                time.sleep(0.2)

    def _reopen(self, sequence: StereoSequence) -> StereoSequence:
        """Return the recording with its new frames, if it can be read at this moment."""
        try:
            return self._open_now()
        except TopolocError:  # a frame is being written
            return sequence

    def _open_now(self) -> StereoSequence:
        words = self.source, self.format, self.camera, None, self.topics
        return open_sequence(*words, mask=self.mask)
