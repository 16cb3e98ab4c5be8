"""topoloc benchmark PART."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from topoloc.apps.cli.output import (
    File,
    Flag,
    UsageError,
    check_outputs,
    interruptible,
    progress_bar,
    write_json,
)
from topoloc.apps.report.plotting import load_matplotlib
from topoloc.errors import TopolocError
from topoloc.recordings.atomic import write_text
from topoloc_paper.datasets import (
    RENDERED,
    at_hand,
    quick_datasets,
    real_datasets,
    render_missing,
    rendered_datasets,
)
from topoloc_paper.readme_block import update_readme
from topoloc_paper.settings import Bench, PaperConfig, Progress, WeightFiles
from topoloc_paper.stages import StageStore
from topoloc_paper.tables import Part, tables_of
from topoloc_paper.text_tables import markdown_of

_WORLDS = ("lab", "corridor", "street")


@dataclass(frozen=True)
class Command:
    """Hold the arguments of `topoloc benchmark`."""

    part: Annotated[tyro.conf.Positional[Part], tyro.conf.arg(metavar="PART")] = "paper"
    """paper: everything; or a part: conditions, nodes, speed, peers, recordings (real ones)."""
    out: Annotated[str, tyro.conf.arg(metavar="DIR")] = "topoloc-paper"
    """Where recordings, maps, finished stages, results and report.html lie. The same command goes
    on from what is there."""
    quick: Flag = False
    """A small run on the lab that topoloc brings along: nothing is rendered, networks are trained
    for a few epochs."""
    draft: Flag = False
    """Recordings of the renderer's draft quality."""
    at_hand: Flag = False
    """Take the recordings that are complete and leave out the others, instead of rendering them."""
    worlds: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...", help_behavior_hint="")] = (
        _WORLDS
    )
    """The rendered places: lab, corridor, street, or some of them."""
    data: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="DIR", help_behavior_hint="(default: $TOPOLOC_SHARED/data, ../shared/data)"
        ),
    ] = None
    """The folder of real recordings (seven_scenes, zed_lab, kitti); without one they are left
    out."""
    weights: Annotated[
        str | None,
        tyro.conf.arg(metavar="FILE", help_behavior_hint="(default: none, from scratch)"),
    ] = None
    """SqueezeNet 1.1 trained on ImageNet, for PoseNet and for the learned coarse localizers."""
    vgg11: File = None
    """VGG-11 trained on ImageNet: cnn-fc then stands on it, as in the paper."""
    vgg16: File = None
    """VGG-16 trained on ImageNet, or a NetVLAD checkpoint: cnn-nn and vlad-nn then stand on it, as
    in the paper."""
    epochs: Annotated[
        int | None, tyro.conf.arg(metavar="N", help_behavior_hint="(default: 40, quick 8)")
    ] = None
    """Times that cnn-fc sees each image, at most."""
    posenet_epochs: Annotated[
        int | None, tyro.conf.arg(metavar="N", help_behavior_hint="(default: 80, quick 8)")
    ] = None
    """The same for PoseNet."""
    json: Annotated[
        str | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(default: DIR/results.json)")
    ] = None
    """Write all the numbers as JSON to this file, too (- for standard output)."""
    readme: File = None
    """Write the table of results into this file, between its markers."""

    def run(self) -> int:
        check_outputs([self.json])
        if unknown := [name for name in self.worlds if name not in _WORLDS]:
            raise UsageError(f"--worlds {unknown[0]}: there are {', '.join(_WORLDS)}")
        out = _made_folder(Path(self.out))
        try:
            with interruptible(), progress_bar() as progress:
                bench = self._bench(out, progress)
                results = tables_of(bench, self.part)
                write_json(str(out / "results.json"), results)
                write_text(out / "results.md", markdown_of(results))
                self._draw(bench, results)
        except KeyboardInterrupt:
            raise TopolocError(
                f"interrupted; the same command goes on from what is in {out}"
            ) from None
        write_json(self.json, results)
        if self.readme is not None:
            update_readme(Path(self.readme), results)
        if self.json != "-":
            print(markdown_of(results))
            print(f"stages: {bench.store.num_done} done, {bench.store.num_kept} kept from before")
            print(f"results: {out / 'results.json'}, {out / 'results.md'}")
            if self.part == "paper":
                print(f"report: {out / 'report.html'}")
        return 0

    def _bench(self, out: Path, progress: Progress) -> Bench:
        weights = WeightFiles(self.weights, self.vgg11, self.vgg16)
        config = (
            PaperConfig.for_quick_run(weights)
            if self.quick
            else PaperConfig(draft=self.draft, weights=weights)
        )
        config = config.with_epochs(self.epochs, self.posenet_epochs)
        store = StageStore(out / "stages")
        if self.quick:
            return Bench(config, quick_datasets(), [], store, out, progress, self._words())
        folder = out / "recordings"
        rendered, missing = [d for d in rendered_datasets(folder) if d.name in self.worlds], []
        if self.part == "recordings":
            rendered = []
        elif not self.at_hand:
            render_missing(
                folder, [r.name for r in RENDERED if r.world in self.worlds], self.draft, progress
            )
        else:
            rendered, missing = at_hand(rendered, folder, self.draft)
        real = real_datasets(self._data())
        if not rendered and not real:
            raise TopolocError(
                f"there is nothing to ask: {folder} holds no complete recording, {self._data()} no"
                " real one"
            )
        return Bench(config, rendered, real, store, out, progress, self._words(), missing)

    def _data(self) -> Path:
        return (
            Path(self.data)
            if self.data is not None
            else Path(os.environ.get("TOPOLOC_SHARED", "../shared")) / "data"
        )

    def _words(self) -> str:
        """Return the command without the paths of files."""
        words = ["topoloc benchmark", self.part] + [
            f"--{name}" for name in ("quick", "draft") if getattr(self, name)
        ]
        return " ".join(
            words
            + [
                f"--{name} {Path(file).name}"
                for name in ("weights", "vgg11", "vgg16")
                if (file := getattr(self, name))
            ]
        )

    def _draw(self, bench: Bench, results: dict[str, object]) -> None:
        if self.part == "paper":
            load_matplotlib()
            from topoloc_paper.page import write_page

            write_page(bench, results)


def _made_folder(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TopolocError(f"cannot write {folder}: {error.strerror}") from error
    return folder
