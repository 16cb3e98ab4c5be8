"""Check that a model of another distribution is opened by its entry point, without being imported
before."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from topoloc.errors import MapError, MissingExtraError
from topoloc.retrieval.coarse import CoarseModel, open_coarse_localizer

_POINTS = """[topoloc.coarse_localizers]
thumbnails = thumbnails_plugin:Thumbnails
broken = no_such_library:Thumbnails
"""
_PLUGIN = """from topoloc import ConfigError

class Thumbnails:
    def __init__(self, model):
        if "size" not in model.settings:
            raise ConfigError("size is missing")
        self.size = model.settings["size"]

    def rank(self, image, features, num_candidates):
        return []
"""


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install a distribution with a coarse localizer and one whose module is missing."""
    metadata = tmp_path / "thumbnails_plugin-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: thumbnails\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(_POINTS)
    (tmp_path / "thumbnails_plugin.py").write_text(_PLUGIN)
    monkeypatch.syspath_prepend(tmp_path)


def test_a_model_of_another_distribution_is_opened(plugin: None):
    opened = open_coarse_localizer(CoarseModel("thumbnails", {"size": 8}, {}))
    assert vars(opened) == {"size": 8}


@pytest.mark.parametrize(
    ("name", "error", "text"),
    [
        ("thumbnails", MapError, "coarse localizer 'thumbnails' is damaged: size is missing"),
        ("broken", MissingExtraError, "'broken' needs no_such_library: install it"),
        ("other", MapError, "'other' is not known to this version (known: surf-vlad, cnn-fc"),
    ],
)
def test_what_is_wrong_is_named(plugin: None, name: str, error: type[Exception], text: str):
    with pytest.raises(error, match=re.escape(text)):
        open_coarse_localizer(CoarseModel(name, {}, {}))
