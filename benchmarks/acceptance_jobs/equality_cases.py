"""List the inputs whose answers `benchmarks/equality.py` compares."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from .varied_images import VARIATIONS
from .workplace import ROOT

Words = tuple[object, ...]


@dataclass(frozen=True)
class Case:
    """Hold the commands of one comparison: preparation, then one that writes results to a file.

    The word `vary` first is no command of topoloc: `varied_images.vary` makes the images.
    """

    name: str
    prepare: tuple[Words, ...]
    query: Words
    results: str


def spread(folder: Path, pattern: str, number: int) -> list[Path]:
    """Return so many files, evenly chosen in their order."""
    files = sorted(folder.rglob(pattern))
    return [files[i * len(files) // number] for i in range(min(number, len(files)))]


def localize(name: str, where: str, *inputs: object, **options: object) -> tuple[Words, str]:
    """Return a command that localizes each image alone, and the name of its file of results."""
    words: list[object] = [word for key, value in options.items() for word in (f"--{key}", value)]
    return ("localize", where, *inputs, "--single", *words, "--json", f"{name}.jsonl"), (
        f"{name}.jsonl"
    )


def varied(folder: str) -> list[str]:
    """Return the recordings that `vary` wrote below a folder."""
    return [f"{folder}/{name}" for name in VARIATIONS]


def cases(data: Path, quick: bool, has_last_step: bool = False) -> list[Case]:
    """Return the cases; the maps of earlier ones are there for later ones."""
    lab = ROOT / "src" / "topoloc" / "demo" / "lab"
    asked = [lab / name for name in ("day", "night", "other_camera", "street", "corridor")]
    demo = Case("demo", (("demo", "--out", "demo"),), *localize("lab", "demo/lab.topo", *asked))
    of_lab = [demo, *_last_steps_of_lab(lab)] if has_last_step and not quick else [demo]
    if not data.is_dir():
        return of_lab
    if quick:
        return [demo, *_quick(data)]
    return of_lab + _recordings(data) + (_last_steps(data) if has_last_step else [])


def _outside(data: Path) -> list[Path]:
    outside = spread(data / "ie_tower", "*.jpg", 30) + spread(data / "gardenspoint", "*.jpg", 15)
    return outside + spread(data / "kitti/sequences/street2/image_0", "*.png", 15)


def _quick(data: Path) -> list[Case]:
    zed = data / "zed_lab"
    few = localize("zed", "zed.topo", f"{zed}/session2@0:99:4")
    away = localize("outside", "zed.topo", *_outside(data)[::4], camera="unknown")
    build_zed = ("build", zed / "session1", "zed.topo")
    return [Case("zed", (build_zed,), *few), Case("out of map", (), *away)]


def _recordings(data: Path) -> list[Case]:
    kitchen, street = data / "seven_scenes/kitchen", data / "kitti/sequences/street1"
    zed, outside = data / "zed_lab", _outside(data)
    colour = spread(kitchen, "*.color.jpg", 70)
    build_zed = ("build", zed / "session1", "zed.topo")
    build_kitchen = ("build", f"{kitchen}@0::2", "kitchen.topo", "--d-thresh", 0.5)
    build_street = ("build", f"{street}@0::2", "street.topo")
    tiles = ("zed.topo", "kitchen.topo", "street.topo")
    inside = [
        *colour[3::14],
        *spread(zed / "session2/image_0", "*.jpg", 6),
        outside[0],
        outside[-1],
    ]
    return [
        Case("zed", (build_zed,), *localize("zed", "zed.topo", f"{zed}/session2")),
        Case("kitchen", (build_kitchen,), *localize("kitchen", "kitchen.topo", f"{kitchen}@1::2")),
        Case("street", (build_street,), *localize("street", "street.topo", f"{street}@1::2")),
        Case(
            "uncalibrated",
            (),
            *localize("uncalibrated", "kitchen.topo", *colour[1:60:2], camera="unknown"),
        ),
        Case("out of map", (), *localize("outside", "zed.topo", *outside, camera="unknown")),
        Case(
            "atlas",
            (("atlas", "create", "atlas", *tiles),),
            *localize("atlas", "atlas", *inside, camera="unknown"),
        ),
    ]


def _last_steps_of_lab(lab: Path) -> list[Case]:
    """Return cases of the demo's recordings for each step after the belief."""
    images = [*spread(lab / "day", "*.jpg", 12), *spread(lab / "night", "*.jpg", 12)]
    floors = ("build", lab / "map_lap1", "lab_floors.topo", "--look-alike-floors")
    vary = ("vary", lab / "day", 4, "lab_varied")
    return [
        Case(
            "lab, uncalibrated",
            (),
            *localize("lab_unknown", "demo/lab.topo", *images, camera="unknown"),
        ),
        Case(
            "lab, varied", (vary,), *localize("lab_varied", "demo/lab.topo", *varied("lab_varied"))
        ),
        Case(
            "lab, look-alike floors",
            (floors,),
            *localize(
                "lab_floors", "lab_floors.topo", lab / "day", lab / "night", *varied("lab_varied")
            ),
        ),
        Case("lab, stream", (), ("follow", "demo/lab.topo", lab / "night"), "lab_stream.jsonl"),
    ]


def _last_steps(data: Path) -> list[Case]:
    """Return cases of real recordings for each step after the belief."""
    kitchen, zed = data / "seven_scenes/kitchen", data / "zed_lab"
    street = data / "kitti/sequences/street1"
    certify = ("certify", "certified.topo", "--walk", zed / "session2", "--map-from-truth")
    certify = (*certify, zed / "session1_from_session2.json", "--max-wrong", 45, "--apply")
    floors = ("build", f"{kitchen}@0::2", "floors.topo", "--d-thresh", 0.5, "--look-alike-floors")
    far = ("build", f"{kitchen}@0-99/350", "far.topo")
    photos = ("localize", "kitchen.topo", *spread(kitchen, "*.color.jpg", 12))
    tiles = ("certified.topo", "floors.topo", "far.topo", "demo/lab.topo", "street.topo")
    mixed = [*varied("kitchen_varied"), *varied("zed_varied"), *varied("lab_varied")]
    of_zed = localize("zed_varied", "zed.topo", *varied("zed_varied"))
    of_kitchen = localize("kitchen_varied", "kitchen.topo", *varied("kitchen_varied"))
    return [
        Case("zed, varied", (("vary", f"{zed}/session2@0:99", 16, "zed_varied"),), *of_zed),
        Case("kitchen, varied", (("vary", f"{kitchen}@1::2", 20, "kitchen_varied"),), *of_kitchen),
        Case(
            "kitchen, look-alike floors",
            (floors,),
            *localize("floors", "floors.topo", f"{kitchen}@1::8", *varied("kitchen_varied")),
        ),
        Case(
            "certificate",
            (("build", zed / "session1", "certified.topo"), certify),
            *localize("certified", "certified.topo", f"{zed}/session2@0::3", *varied("zed_varied")),
        ),
        Case("far views", (far,), *localize("far", "far.topo", f"{kitchen}@100::5")),
        Case(
            "photos",
            (),
            (*photos, "--camera", "unknown", "--json", "photos.jsonl"),
            "photos.jsonl",
        ),
        Case("stream", (), ("follow", "zed.topo", f"{zed}/session2@0:40"), "stream.jsonl"),
        Case(
            "atlas, varied",
            (("atlas", "create", "atlas2", *tiles),),
            *localize("atlas2", "atlas2", *mixed, f"{street}@1::10"),
        ),
    ]
