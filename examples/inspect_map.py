"""What is in a map: its nodes from above with the 95 % ellipses of their points, and how exactly
the points are known.

    python examples/inspect_map.py [MAP] [--out FILE.png]

Without a map one of the built-in lab is made. The same tables are read by any language:
docs/map-format.md.
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import EllipseCollection

import topoloc
from topoloc.demo.recordings import SHIPPED
from topoloc.localization.pose_fit import LocalMap

CHI_95 = np.sqrt(5.991)  # radius of the 95 % ellipse of a plane Gaussian, in standard deviations
PLAN = np.ix_(range(2), range(2))  # x and y of the lab's world, whose z is up


def main(map_file: Path | None, out: Path) -> None:
    topomap = (
        topoloc.TopoMetricMap.load(map_file)
        if map_file
        else topoloc.build_map(topoloc.open_sequence(SHIPPED / "map_lap1"))
    )
    local_maps = [
        LocalMap.of_node(node) for node in topomap.nodes
    ]  # the points of each node, in the world
    points = np.concatenate([local_map.points_world for local_map in local_maps])
    covariances = np.concatenate([local_map.covariances for local_map in local_maps])
    sigmas_cm = 100.0 * np.sqrt(np.trace(covariances, axis1=1, axis2=2))
    print(
        f"{len(topomap.nodes)} nodes, {len(points)} points, {len(topomap.edges)} edges,"
        f" {topomap.length_m:.1f} m"
    )
    print(f"D_thresh {topomap.config.d_thresh:.2f} m, lambda {topomap.config.lambda_rot:.2f} m/rad")
    print(
        "standard deviation of a point: "
        + ", ".join(f"{q} %: {np.percentile(sigmas_cm, q):.2f} cm" for q in (10, 50, 90))
    )

    fig, ax = plt.subplots(figsize=(9, 7), layout="constrained")
    lengths, axes = np.linalg.eigh(covariances[:, PLAN[0], PLAN[1]])
    sizes = 2.0 * CHI_95 * np.sqrt(lengths)
    angles = np.rad2deg(np.arctan2(axes[:, 1, 1], axes[:, 0, 1]))
    ellipses = EllipseCollection(
        sizes[:, 1],
        sizes[:, 0],
        angles,
        units="xy",
        offsets=points[:, :2],
        offset_transform=ax.transData,
        facecolor="#4878a8",
        alpha=0.07,
    )
    ax.add_collection(ellipses)
    poses = [summary.world_from_cam for summary in topomap.summaries]
    centres, looks = (
        np.array([p.translation[:2] for p in poses]),
        np.array([p.rotation[:2, 2] for p in poses]),
    )
    ax.quiver(*centres.T, *looks.T, color="#c0392b", width=0.002, scale=45)
    ax.plot(*centres.T, ".", color="#c0392b")
    low, high = np.percentile(points[:, :2], (0.5, 99.5), axis=0) + np.array([[-0.3], [0.3]])
    ax.set(
        aspect="equal",
        xlabel="x (m)",
        ylabel="y (m)",
        xlim=(low[0], high[0]),
        ylim=(low[1], high[1]),
    )
    fig.savefig(out, dpi=110)
    print(f"written to {out}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("map", nargs="?", type=Path, help="a map file")
    parser.add_argument("--out", type=Path, default=Path("map.png"), help="the picture")
    args = parser.parse_args()
    main(args.map, args.out)
