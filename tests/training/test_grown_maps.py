"""Test a map that has grown: k-NN localizers add the vectors of new images, and cnn-fc is
widened and resumes."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_place_vectors import NO_FEATURES, silent

from built_room import built_room
from topoloc.apps.cli import main
from topoloc.errors import TrainingError
from topoloc.lifelong.session_content import update_coarse_models
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.stored_images import decode_stored_image
from topoloc.retrieval.coarse import CoarseModel, open_coarse_localizer
from topoloc_training import cnn_fc, cnn_nn
from topoloc_training.classifier_config import (
    AugmentationConfig,
    CnnFcConfig,
    CnnNnConfig,
    NetworkInputConfig,
    TrainingConfig,
)
from topoloc_training.coarse_training import (
    CoarseTrainingConfig,
    in_ids,
    train_coarse,
    training_set_of,
)
from topoloc_training.training_set import TrainingSet

TINY = NetworkInputConfig(64, 48)
HOW = TrainingConfig(
    max_epochs=60, patience=60, batch_size=7, held_out=0.0, num_threads=1, learning_rate=3e-3
)
CLASSIFIER = CnnFcConfig(
    TINY, HOW, AugmentationConfig(occlusion=0.0), label_spread=0.0, tuning_epochs=25
)


@pytest.fixture(scope="module")
def grown(tiny_recording: Path) -> TopoMetricMap:
    """Return a map. The nodes of `half` are its first nodes."""
    return built_room(tiny_recording)


@pytest.fixture(scope="module")
def half(grown: TopoMetricMap) -> TrainingSet:
    """Return the training set of the first nodes."""
    whole, num = training_set_of(grown), len(grown.summaries) * 2 // 3
    of_first = np.flatnonzero(whole.node_ids < num)
    return replace(
        whole,
        jpegs=[whole.jpegs[k] for k in of_first],
        world_from_cams=[whole.world_from_cams[k] for k in of_first],
        node_ids=whole.node_ids[of_first],
        node_distances=whole.node_distances[of_first, :num],
    )


def _right(model: CoarseModel, grown: TopoMetricMap) -> np.ndarray:
    """Return for each mapping image if its node is ranked first."""
    localizer = open_coarse_localizer(model)
    ranked = [
        localizer.rank(decode_stored_image(image.jpeg), NO_FEATURES, 1)[0].row
        for image in grown.place_images
    ]
    return np.array(ranked) == [image.node_id for image in grown.place_images]


def test_vectors_of_new_pictures_join(grown: TopoMetricMap, half: TrainingSet):
    known = cnn_nn.train(half, "compact", None, CnnNnConfig(TINY), silent)
    new = [image for image in grown.place_images if image.node_id >= half.num_nodes]
    assert len(new) > 0
    with_known = grown.with_first_layer(coarse_models={"cnn-nn": known})
    taught, not_updated = update_coarse_models(with_known, {}, new)
    assert not_updated == []
    taught_model = taught.first_layer.coarse_models["cnn-nn"]
    joined = taught_model.arrays
    assert np.array_equal(joined["vectors"][: len(half.jpegs)], known.arrays["vectors"])
    assert joined["node_ids"].tolist() == [*half.node_ids, *(image.node_id for image in new)]
    is_new = np.array([image.node_id >= half.num_nodes for image in grown.place_images])
    assert not _right(known, grown)[is_new].any()
    assert _right(taught_model, grown).mean() > 0.9


def test_a_classifier_is_widened_and_goes_on(grown: TopoMetricMap, half: TrainingSet):
    known = in_ids(
        cnn_fc.train(half, "compact", None, CLASSIFIER, silent), list(range(half.num_nodes))
    )
    with_known = grown.with_first_layer(coarse_models={"cnn-fc": known})
    assert update_coarse_models(with_known, {}, list(grown.place_images))[1] == ["cnn-fc"]
    config = CoarseTrainingConfig(cnn_fc=CLASSIFIER)
    widened = train_coarse(with_known, "cnn-fc", "compact", "map", config, silent)
    facts = widened.settings["trained"]
    assert (facts["widened_from"], widened.settings["num_nodes"]) == (
        half.num_nodes,
        len(grown.summaries),
    )
    assert facts["epochs"] == CLASSIFIER.tuning_epochs
    anew = train_coarse(
        grown,
        "cnn-fc",
        "compact",
        "scratch",
        replace(config, cnn_fc=replace(CLASSIFIER, training=replace(HOW, max_epochs=25))),
    )
    assert _right(widened, grown).mean() > 0.8  # 12 of 14 on some processors, 14 on others
    assert _right(widened, grown).mean() >= _right(anew, grown).mean()
    with pytest.raises(TrainingError, match="stands on compact, not on squeezenet1_1"):
        train_coarse(with_known, "cnn-fc", "squeezenet1_1", "map", config)


def test_only_existing_models_are_widened(
    room_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    path = shutil.copy(room_map, tmp_path / "room.topo")
    assert main(["train", str(path), "--coarse", "cnn-fc", "--weights", "map"]) == 1
    assert "has no cnn-fc to begin with" in capsys.readouterr().err
    assert main(["train", str(path), "--coarse", "cnn-nn", "--weights", "map"]) == 1
    assert "learns new pictures as they join" in capsys.readouterr().err
