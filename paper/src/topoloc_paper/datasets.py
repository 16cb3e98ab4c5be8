"""Define the places of the benchmark: mapping recordings, query recordings, node placement.

There are three kinds of places: rendered counterparts of the paper's three (street for CARLA,
corridor, lab), real recordings if a folder with them is given, and for the quick run the recordings
that ship with topoloc.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from topoloc.demo.recordings import SHIPPED
from topoloc.errors import TrajectoryError
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.open import open_sequence
from topoloc_worlds.conditions import find_condition
from topoloc_worlds.layout import SETTINGS, Layout, missing_frames
from topoloc_worlds.recorder import RecordConfig, record
from topoloc_worlds.rendering.renderer import RenderConfig
from topoloc_worlds.routes import plan_route
from topoloc_worlds.worlds import find_world

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class PaperRecording:
    """One rendered recording: `topoloc simulate WORLD NAME` with the settings of `words` gives the
    same pictures."""

    name: str
    world: str
    condition: str = "day"
    laps: float = 1.0
    spacing: float = 0.25
    lateral: float = 0.0
    take: int = 0
    mono: bool = False

    @property
    def words(self) -> str:
        """Return the arguments of `topoloc simulate`."""
        words = [self.world, self.name]
        words += ["--condition", self.condition] if self.condition != "day" else []
        words += ["--laps", f"{self.laps:g}"] if self.laps != 1.0 else []
        words += ["--take", str(self.take)] if self.take else []
        words += ["--spacing", f"{self.spacing:g}"]
        words += ["--lateral", f"{self.lateral:g}"] if self.lateral else []
        return " ".join(words + (["--mono"] if self.mono else []))

    def config(self, draft: bool) -> RecordConfig:
        world = find_world(self.world)
        route = replace(
            world.route(),
            laps=self.laps,
            spacing=self.spacing,
            lateral=self.lateral,
            seed=self.take,
        )
        render = RenderConfig.draft() if draft else RenderConfig()
        return RecordConfig(
            route=route, baseline=None if self.mono else world.baseline, render=render
        )


RENDERED = (
    PaperRecording("lab_map", "lab", laps=2.0, spacing=0.15),
    PaperRecording("lab_day", "lab", take=1, spacing=0.25, lateral=0.1, mono=True),
    PaperRecording("lab_night", "lab", "night", take=2, spacing=0.25, lateral=0.1, mono=True),
    PaperRecording("corridor_map", "corridor", laps=2.0, spacing=0.3),
    PaperRecording("corridor_day", "corridor", take=1, spacing=0.8, lateral=0.2, mono=True),
    PaperRecording(
        "corridor_evening", "corridor", "evening", take=2, spacing=0.8, lateral=0.2, mono=True
    ),
    PaperRecording(
        "corridor_night", "corridor", "night", take=3, spacing=0.8, lateral=0.2, mono=True
    ),
    PaperRecording("street_map", "street", spacing=1.25),
    PaperRecording("street_clear", "street", "clear", take=1, spacing=8.0, lateral=3.5, mono=True),
    PaperRecording(
        "street_cloudy", "street", "cloudy", take=2, spacing=8.0, lateral=3.5, mono=True
    ),
    PaperRecording("street_rain", "street", "rain", take=3, spacing=8.0, lateral=3.5, mono=True),
)


@dataclass(frozen=True)
class Dataset:
    """Hold a place: its mapping recordings, its query recordings by label, and the paper's values
    of Eq. 1.

    `d_thresh` is in metres, `lambda_rot` in metres a radian. `sweep` holds the D_thresh that the
    node sweep tries. `map_from_truth` names a JSON file with a 4x4 matrix, which transforms the
    world of the queries into that of the map.
    """

    name: str
    title: str
    mapping: tuple[str, ...]
    queries: dict[str, str]
    d_thresh: float
    lambda_rot: float = 2.0
    is_real: bool = False
    map_from_truth: str | None = None
    sweep: tuple[float, ...] = (0.25, 0.5, 1.0, 2.0, 4.0)
    elsewhere: tuple[str, ...] = field(default=())

    def open_mapping(self) -> list[StereoSequence]:
        return [open_sequence(path) for path in self.mapping]

    def open_queries(self, label: str) -> StereoSequence:
        return open_sequence(self.queries[label])

    def map_from_query_truth(self) -> Rigid3:
        """The queries' world in the map's. Raises TrajectoryError."""
        if self.map_from_truth is None:
            return Rigid3.identity()
        try:
            content = json.loads(Path(self.map_from_truth).read_text(encoding="utf-8"))
            (matrix,) = (
                [v for v in content.values() if isinstance(v, list)]
                if isinstance(content, dict)
                else [content]
            )
            return Rigid3.from_matrix(np.array(matrix, dtype=np.float64))
        except (OSError, ValueError, TypeError) as error:
            raise TrajectoryError(
                f"{self.map_from_truth}: one 4x4 matrix as JSON is needed"
            ) from error


_STREET_SWEEP = (2.5, 5.0, 10.0, 20.0, 40.0, 80.0)


def rendered_datasets(folder: Path) -> list[Dataset]:
    """The paper's three places, of the rendered recordings in `folder`."""

    def path(name: str) -> str:
        return str(folder / name)

    lab = {"day": path("lab_day"), "night": path("lab_night")}
    corridor = {light: path(f"corridor_{light}") for light in ("evening", "day", "night")}
    street = {weather: path(f"street_{weather}") for weather in ("clear", "cloudy", "rain")}
    return [
        Dataset("lab", "Lab, 5 x 4 m", (path("lab_map"),), lab, 2.0),
        Dataset(
            "corridor",
            "Corridor, 25 x 18 m",
            (path("corridor_map"),),
            corridor,
            2.0,
            sweep=(0.25, 0.5, 1.0, 2.0, 4.0, 8.0),
        ),
        Dataset(
            "street", "Street, 333 x 81 m", (path("street_map"),), street, 20.0, sweep=_STREET_SWEEP
        ),
    ]


def quick_datasets() -> list[Dataset]:
    """The lab that topoloc brings along, by day and by night."""
    mapping = (str(SHIPPED / "map_lap1"), str(SHIPPED / "map_lap2"))
    queries = {"day": str(SHIPPED / "day"), "night": str(SHIPPED / "night")}
    elsewhere = (str(SHIPPED / "corridor"), str(SHIPPED / "street"))
    return [
        Dataset(
            "lab",
            "Lab, 5 x 4 m (the recordings of the demo)",
            mapping,
            queries,
            2.0,
            sweep=(0.5, 2.0),
            elsewhere=elsewhere,
        )
    ]


def real_datasets(data: Path) -> list[Dataset]:
    """The real recordings below `data` that are there: 7-Scenes kitchen, a lab by ZED 2, two
    streets of KITTI."""
    kitchen, street = (
        str(data / "seven_scenes" / "kitchen"),
        str(data / "kitti" / "sequences" / "street"),
    )
    zed = data / "zed_lab"
    found = [
        Dataset(
            "kitchen",
            "7-Scenes kitchen, RGB-D",
            (f"{kitchen}@0-59/100",),
            {"later": f"{kitchen}@60-99/100"},
            0.5,
            is_real=True,
        ),
        Dataset(
            "zed-lab",
            "A lab by ZED 2, two sessions",
            (str(zed / "session1"),),
            {"session 2": f"{zed / 'session2'}@0:99"},
            0.5,
            is_real=True,
            map_from_truth=str(zed / "session1_from_session2.json"),
        ),
        Dataset(
            "kitti-1",
            "KITTI, 60 m of street",
            (f"{street}1@0::2",),
            {"odd": f"{street}1@1::2"},
            5.0,
            is_real=True,
        ),
        Dataset(
            "kitti-2",
            "KITTI, 52 m of slip road",
            (f"{street}2@0::2",),
            {"odd": f"{street}2@1::2"},
            5.0,
            is_real=True,
        ),
    ]
    return [
        dataset
        for dataset in found
        if all(Path(path.partition("@")[0]).exists() for path in dataset.mapping)
    ]


def is_complete(recording: PaperRecording, folder: Path, draft: bool) -> bool:
    """Whether all pictures of this very recording lie in `folder`; whether Mitsuba is there does
    not matter."""
    config, world = recording.config(draft), find_world(recording.world)
    try:
        stored = json.loads((folder / SETTINGS).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    asked = json.loads(json.dumps({**asdict(config), "camera": config.camera.to_json()}))
    asked |= {"world": world.name, "condition": find_condition(recording.condition).name}
    if any(stored.get(key) != value for key, value in asked.items()):
        return False
    route = plan_route(world.loop, world.camera_height, config.route)
    return not missing_frames(Layout(folder, config.camera, config.baseline), route.num_frames)


def render_missing(folder: Path, names: Sequence[str], draft: bool, progress: Progress) -> None:
    """Render the incomplete recordings among `names`. Complete ones stay as they are.

    Raises:
        MissingExtraError: Mitsuba is not installed.
        TopolocError: see `record`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for recording in RENDERED:
        if recording.name not in names or is_complete(recording, folder / recording.name, draft):
            continue
        stages = {"frames": f"rendering {recording.name}", "light": f"light for {recording.name}"}
        record(
            find_world(recording.world),
            find_condition(recording.condition),
            folder / recording.name,
            recording.config(draft),
            lambda stage, done, total, stages=stages: progress(stages[stage], done, total),
        )


def at_hand(
    datasets: Sequence[Dataset], folder: Path, draft: bool
) -> tuple[list[Dataset], list[str]]:
    """Return the rendered data sets without incomplete recordings, and the names of these."""
    missing = [
        recording.name
        for recording in RENDERED
        if not is_complete(recording, folder / recording.name, draft)
    ]
    kept = []
    for dataset in datasets:
        if any(Path(path).name in missing for path in dataset.mapping):
            continue
        queries = {
            label: path for label, path in dataset.queries.items() if Path(path).name not in missing
        }
        if queries:
            kept.append(replace(dataset, queries=queries))
    return kept, missing
