from __future__ import annotations

import numpy as np
import pytest

from topoloc.errors import TopolocError
from topoloc_worlds.routes import frame_poses, plan_route
from topoloc_worlds.worlds import WORLDS, find_world


@pytest.mark.parametrize("name", WORLDS)
@pytest.mark.parametrize("reverse", [False, True])
def test_every_world_has_a_line_to_follow(name: str, reverse: bool):
    world = find_world(name)
    config = world.route()
    route = plan_route(
        world.loop,
        world.camera_height,
        type(config)(**{**vars(config), "reverse": reverse, "num_frames": 50}),
    )
    centres = np.array([pose.translation for pose in frame_poses(route)])
    assert 0.5 < centres[:, 2].mean() < 2.5
    corners = np.array(world.loop)
    assert np.all(centres[:, :2] > corners.min(axis=0) - 0.6)
    assert np.all(centres[:, :2] < corners.max(axis=0) + 0.6)


@pytest.mark.parametrize(
    ("name", "size"),
    [("lab", (5, 4)), ("corridor", (25, 18)), ("hospital", (21, 13)), ("street", (333, 81))],
)
def test_lines_fit_the_sizes_of_the_paper(name: str, size: tuple[float, float]):
    across = np.ptp(np.array(find_world(name).loop), axis=0)
    assert np.all(np.sort(across) <= np.sort(size))
    assert np.all(across > 0.3 * np.array(sorted(size, reverse=bool(across[0] > across[1]))))


def test_an_unknown_world_gets_the_list():
    with pytest.raises(
        TopolocError, match="unknown world 'moon'; worlds: lab, corridor, hospital, street"
    ):
        find_world("moon")
