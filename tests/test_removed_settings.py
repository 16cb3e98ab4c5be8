"""Test files of earlier versions with settings that no longer exist."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest

from topoloc.apps.cli.settings_file import all_tables, config_class, read_settings
from topoloc.errors import ConfigError
from topoloc.mapping.topomap import TopoMetricMap

FIXTURES = Path(__file__).parent / "fixtures" / "aea690a"


@pytest.fixture
def no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@pytest.mark.usefixtures("no_warning")
def test_the_old_defaults_are_read_in_silence():
    settings = read_settings(str(FIXTURES / "settings.toml"))
    for name in all_tables():
        assert settings.get(config_class(name)) == config_class(name)()


def test_changed_keys_are_named_once(tmp_path: Path):
    path = tmp_path / "my.toml"
    path.write_text(
        "build.points.max_depth_step = 0.1\nbuild.landmarks.gate = 4\nlocalize.num_candidates = 2\n"
        "[join]\nconsensus.rival_share = 0.9\n"
        "[robot]\nmap_frame = 'site'\nrate = 20\njump = 'smooth'\n"
    )
    with pytest.warns(UserWarning, match="no longer settings") as caught:
        read_settings(str(path))
    named = "build.points.max_depth_step, join.consensus.rival_share, robot.jump"
    assert [str(one.message) for one in caught] == [
        f"{path}: no longer settings, without effect: {named}"
    ]


@pytest.mark.usefixtures("no_warning")
@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("build.points = 3", "build.points: no such setting"),
        ("build.points.max_depth_stop = 0.1", "build.points: no such setting"),
        ("build.nodes.d_tresh = 1", "did you mean build.nodes.d_thresh?"),
        ("slam.odometry.windows = 8", "slam: no such table"),
        ("slam = 3", "slam: no such table"),
    ],
)
def test_keys_that_never_existed_are_refused(text: str, said: str, tmp_path: Path):
    path = tmp_path / "my.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        read_settings(str(path))
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("schema", [1, 2, 3])
def test_old_maps_are_read(schema: int):
    with pytest.warns(UserWarning, match=r"build\.max_node_points, .*build\.template_side_px"):
        topomap = TopoMetricMap.load(FIXTURES / f"schema_{schema}.topo")
    with topomap:
        assert len(topomap.nodes) > 0
        assert len(topomap.layers[topomap.kind].coarse_models) > 0
