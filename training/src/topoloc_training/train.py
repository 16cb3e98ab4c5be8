"""topoloc train MAP|ATLAS --coarse NAME."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from topoloc.apps.cli.output import File, Flag, UsageError, check_outputs, progress_bar, write_json
from topoloc.apps.cli.settings_file import read_settings
from topoloc.apps.cli.tile_option import TileOption, select_tile
from topoloc.atlas.place import open_place
from topoloc.mapping.storage.map_reading import list_coarse_models
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.retrieval.coarse import CoarseModel
from topoloc_training.classifier_config import BackboneName
from topoloc_training.coarse_storing import store_coarse
from topoloc_training.coarse_training import CoarseTrainingConfig, train_coarse


@dataclass(frozen=True)
class Command:
    """Define the arguments of `topoloc train`."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP|ATLAS")]
    """The map file; it gets the coarse localizer, in the place of one of the same name. Or an
    atlas, with --tile."""
    coarse: Literal["cnn-fc", "cnn-nn", "vlad-nn"]
    """The coarse localizer to train."""
    backbone: BackboneName = "squeezenet1_1"
    """The network it stands on."""
    weights: Annotated[
        str | None,
        tyro.conf.arg(metavar="FILE|scratch|map", help_behavior_hint="(default: the published)"),
    ] = None
    """The network's weights: a PyTorch file of torchvision's or NetVLAD's layout, `scratch` for
    random ones, `map` (cnn-fc) for what the map's own one knows: its output is widened by new
    nodes, and tuned."""
    default: Flag = False
    """From now on it answers where --coarse is not given."""
    tile: TileOption = None
    """Of an atlas: the tile whose map gets it."""
    out: Annotated[
        str | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(default: MAP itself)")
    ] = None
    """Write the map with the new coarse localizer to this file and leave MAP as it is."""
    checkpoint: File = None
    """cnn-fc: write the state of the training to this file after each epoch, and go on from it if
    it is there already."""
    json: File = None
    """Write what was trained to this file (- for standard output)."""
    config: File = None
    """All other settings: a TOML file, as `topoloc config train` prints it."""

    def run(self) -> int:
        place = open_place(self.map)
        tile_id = select_tile(place, self.tile)
        if self.out is not None and tile_id:
            raise UsageError("--out needs a map file: a tile gets its coarse localizer itself")
        if self.checkpoint is not None and self.coarse != "cnn-fc":
            raise UsageError("--checkpoint is for cnn-fc; the others are done in one go")
        check_outputs(
            [self.out or (None if tile_id else self.map), self.json, self.checkpoint],
            inputs=[path for path in (self.weights, self.config) if path is not None],
        )
        config = read_settings(self.config).get(CoarseTrainingConfig)
        start = time.perf_counter()
        facts, model = place.edit(
            tile_id, lambda path: self._trained(path, Path(self.out or path), config)
        )
        facts |= {"seconds": round(time.perf_counter() - start, 1), "default": self.default}
        if self.json != "-":
            size = f"{facts['bytes'] / 1e6:.2f} MB, {facts['seconds']:.0f} s"
            print(
                f"{self.out or self.tile or self.map}: {self.coarse} on"
                f" {self.backbone}{_widened(model)}, {size}"
            )
        for warning in warnings_of(model):
            print(f"warning: {warning}", file=sys.stderr)
        write_json(self.json, facts)
        return 0

    def _trained(
        self, path: Path, target: Path, config: CoarseTrainingConfig
    ) -> tuple[dict[str, Any], CoarseModel]:
        """Train with the map at `path`. Return the facts of the new coarse localizer in `target`,
        and the localizer."""
        checkpoint = None if self.checkpoint is None else Path(self.checkpoint)
        with progress_bar() as progress:
            topomap = TopoMetricMap.load(path)
            model = train_coarse(
                topomap, self.coarse, self.backbone, self.weights, config, progress, checkpoint
            )
        store_coarse(path, target, model, self.default)
        (facts,) = [facts for facts in list_coarse_models(target) if facts["name"] == self.coarse]
        return facts, model


def _widened(model: CoarseModel) -> str:
    before = (model.settings.get("trained") or {}).get("widened_from")
    return (
        "" if before is None else f", widened from {before} to {model.settings['num_nodes']} nodes"
    )


def warnings_of(model: CoarseModel) -> list[str]:
    """Return warnings about a training that ended without an error."""
    warnings = []
    trained = model.settings.get("trained")
    if isinstance(trained, dict) and "not finite" in trained["stopped_by"]:
        warnings.append(f"{trained['stopped_by']}; epoch {trained['best_epoch']} is kept")
    if model.settings.get("weights") is None and model.name != "cnn-fc":
        warnings.append(
            f"{model.name} stands on random features: in other light it will name wrong nodes"
        )
    elif model.settings.get("weights") is None:
        warnings.append(
            "cnn-fc began at random and knows these images alone: in other light weights of"
            " ImageNet do better"
        )
    return warnings
