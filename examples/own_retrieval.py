"""A retrieval of your own: thumbnails as global descriptors, registered from outside the package.

    python examples/own_retrieval.py [--out FILE]

Any network that turns an image into a vector takes the place of `describe`. It maps the demo's lab,
ranks nodes by thumbnails, localizes images of another walk, and prints the median error.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

import topoloc
from topoloc.demo.recordings import SHIPPED
from topoloc.plugin import (
    CoarseLocalizer,
    CoarseModel,
    Features,
    NodeScore,
    register_coarse_localizer,
)

NAME = "thumbnails"


def describe(image: np.ndarray) -> np.ndarray:
    """Return the unit vector of an image: 16 x 12 grey levels without their mean."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    small = cv2.resize(grey, (16, 12), interpolation=cv2.INTER_AREA).astype(np.float32).ravel()
    small -= small.mean()
    return small / max(float(np.linalg.norm(small)), 1e-6)


class Thumbnails(CoarseLocalizer):
    """Rank nodes by the most similar thumbnail of a mapping image."""

    def __init__(self, model: CoarseModel) -> None:
        self.vectors, self.nodes = model.arrays["vectors"], model.arrays["node_ids"]

    def rank(self, image: np.ndarray, features: Features, num_candidates: int) -> list[NodeScore]:
        """Return the best nodes. In an open map, `node_ids` holds rows."""
        similarities, best = self.vectors @ describe(image), dict[int, float]()
        for k in np.argsort(-similarities):
            best.setdefault(int(self.nodes[k]), float(similarities[k]))
        return [NodeScore(row, score) for row, score in list(best.items())[:num_candidates]]


def main(out: Path) -> None:
    register_coarse_localizer(NAME, Thumbnails)  # also before a saved map is opened
    topomap = topoloc.build_map(topoloc.open_sequence(SHIPPED / "map_lap1"))
    images = [cv2.imdecode(np.frombuffer(one.jpeg, np.uint8), 0) for one in topomap.place_images]
    arrays = {
        "vectors": np.array([describe(image) for image in images]),
        "node_ids": np.array([one.node_id for one in topomap.place_images]),
    }
    models = {**topomap.first_layer.coarse_models, NAME: CoarseModel(NAME, {}, arrays)}
    replace(topomap.with_first_layer(coarse_models=models), default_coarse=NAME).save(out)

    localizer = topoloc.Localizer(out)
    queries = topoloc.open_sequence(SHIPPED / "day")[::4]
    errors = []
    for frame in queries:
        result = localizer.localize(frame.image, frame.camera)
        if isinstance(result, topoloc.Localization):
            off = result.world_from_cam.translation - frame.world_from_cam.translation
            errors.append(np.linalg.norm(off))
    print(
        f"{len(errors)} of {len(queries)} localized, median error {100 * np.median(errors):.2f} cm"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("lab_thumbs.topo"), help="the map file")
    main(parser.parse_args().out)
