"""A feature type of your own: ORB of OpenCV, registered from outside of the package.

    python examples/own_features.py [--out FILE]

It maps the demo's lab with ORB, localizes images of another walk, and prints the median error. Its
answers are marked as not calibrated, because no weights were fitted to it.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

import topoloc
from topoloc.demo.recordings import SHIPPED
from topoloc.plugin import (
    FeatureConfig,
    Features,
    FeatureType,
    GuidedThresholds,
    register_feature_type,
)

NUM_BITS = 256


def extract_orb(image: np.ndarray, config: FeatureConfig, num_threads: int | None) -> Features:
    """Return ORB features, strongest first. Each bit becomes +1/16 or -1/16. Then descriptors have
    unit length, and their scalar product is 1 - Hamming distance / 128."""
    points, codes = cv2.ORB_create(config.max_features).detectAndCompute(image, None)
    if codes is None:
        return Features.empty(NUM_BITS)
    order = np.argsort([-point.response for point in points], kind="stable")
    points = [points[row] for row in order]
    bits = np.unpackbits(codes[order], axis=1).astype(np.float32)
    return Features(
        np.array([point.pt for point in points], np.float32),
        np.array([point.size for point in points], np.float32),
        np.deg2rad([point.angle for point in points]).astype(np.float32),
        np.array([point.response for point in points], np.float32),
        (2 * bits - 1) / np.float32(np.sqrt(NUM_BITS)),
    )


ORB = FeatureType(
    "orb",
    extract_orb,
    descriptor_size=NUM_BITS,
    guided=GuidedThresholds(min_similarity=0.5, min_margin=0.06, max_scale=1.6, max_turn=0.6),
    distant=GuidedThresholds(min_similarity=0.6, min_margin=0.06, max_scale=1.5, max_turn=0.35),
    descriptor_scale=127 * np.sqrt(NUM_BITS),  # a component is stored as -127 or 127
    ratio=0.85,
    sigma_px=1.5,
)


def main(out: Path) -> None:
    register_feature_type(ORB)  # also before a saved map is opened
    config = topoloc.BuildConfig(features=FeatureConfig(kind=ORB.name))
    topoloc.build_map(topoloc.open_sequence(SHIPPED / "map_lap1"), config).save(out)

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
    parser.add_argument("--out", type=Path, default=Path("lab_orb.topo"), help="the map file")
    main(parser.parse_args().out)
