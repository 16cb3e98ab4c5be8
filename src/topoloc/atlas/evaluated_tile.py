"""Evaluate an atlas against ground truth in the world of one tile."""

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
    """Hold an atlas and the tile whose world the ground truth is in.

    The whole atlas is queried. `topomap` is the tile's map, whose nodes are compared with the
    truth.
    """

    localizer: AtlasLocalizer
    tile_id: str
    topomap: TopoMetricMap

    @staticmethod
    def of(localizer: AtlasLocalizer, tile_id: str) -> EvaluatedTile:
        """Open the map of the tile.

        Raises:
            AtlasError: there is no such tile, or its map is missing.
            MapError: the map is damaged.
        """
        return EvaluatedTile(
            localizer,
            tile_id,
            TopoMetricMap.load(localizer.atlas.map_path(localizer.atlas.tile(tile_id))),
        )

    def localize(
        self, image: Image, camera: Camera | UncalibratedCamera | None, t_ns: int | None = None
    ) -> Localization | NotLocalized:
        """Localize an image, see `AtlasLocalizer.localize`."""
        return self.localizer.localize(image, camera, t_ns=t_ns)

    def truth_in_result_world(
        self, result: Localization | NotLocalized, world_from_cam: Rigid3
    ) -> Rigid3 | None:
        """Return the true pose in the world of the tile of the result.

        None if the transform between the two tiles is unknown. Then no pose there is correct.
        """
        tile, answered = self.localizer.atlas.tile(self.tile_id), result.provenance.tile
        other = tile if answered is None else self.localizer.atlas.tile(answered)
        other_from_world = other.from_world_of(tile)
        return None if other_from_world is None else other_from_world @ world_from_cam
