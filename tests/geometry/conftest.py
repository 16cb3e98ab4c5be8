"""Run tests of solvers with PoseLib, and as on Linux on ARM, where it has no package."""

from collections.abc import Iterator

import pytest

from topoloc.geometry import pose_sampling


@pytest.fixture(scope="module", params=["poselib", "no_poselib"])
def solvers(request: pytest.FixtureRequest) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        if request.param == "no_poselib":
            patch.setattr(pose_sampling, "poselib", None)
        yield
