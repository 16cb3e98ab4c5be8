"""An atlas judged by truth that is given in one tile's world."""

from __future__ import annotations

from dataclasses import dataclass

from topoloc.atlas.atlas_localizer import AtlasLocalizer
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.geometry.uncalibrated_camera import UncalibratedCamera
from topoloc.localization.result import Localization, NotLocalized
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.retrieval.coarse import Image


@dataclass(frozen=True, eq=False)
class EvaluatedTile:
    """The whole atlas is asked; `topomap` is the tile's map, whose nodes the truth is compared
    with."""

    localizer: AtlasLocalizer
    tile_id: str
    topomap: TopoMetricMap

    @staticmethod
    def of(localizer: AtlasLocalizer, tile_id: str) -> EvaluatedTile:
        """Raises AtlasError: no such tile, or its map is missing; MapError: it is damaged."""
        return EvaluatedTile(
            localizer,
            tile_id,
            TopoMetricMap.load(localizer.atlas.map_path(localizer.atlas.tile(tile_id))),
        )

    def localize(
        self, image: Image, camera: Camera | UncalibratedCamera | None, t_ns: int | None = None
    ) -> Localization | NotLocalized:
        """As `AtlasLocalizer.localize`."""
        return self.localizer.localize(image, camera, t_ns=t_ns)

    def truth_in_result_world(
        self, result: Localization | NotLocalized, world_from_cam: Rigid3
    ) -> Rigid3 | None:
        """The true pose in the world of the tile that answered; None where the atlas does not know
        how that lies to this one, so that no pose there is right."""
        tile, answered = self.localizer.atlas.tile(self.tile_id), result.provenance.tile
        other = tile if answered is None else self.localizer.atlas.tile(answered)
        other_from_world = other.from_world_of(tile)
        return None if other_from_world is None else other_from_world @ world_from_cam
