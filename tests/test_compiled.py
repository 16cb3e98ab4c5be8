"""Test the cache of machine code: read from its folder, stored if possible, and functions
work without it."""

from __future__ import annotations

import ast
import inspect
import os
import subprocess
import sys
from pathlib import Path
from textwrap import dedent

import pytest

from topoloc.compiled import KERNELS, kernel

_MODULE = """
from topoloc.compiled import kernel

@kernel(error_model="numpy")
def twice(x):
    return 2.0 * x

@kernel()
def more(x):
    return twice(x) + 1.0
"""
_CALL = (
    "import own_kernels as k; print(k.more(3.0), sum(k.more.stats.cache_hits.values()),"
    " sum(k.more.stats.cache_misses.values()))"
)


@pytest.fixture
def module(tmp_path: Path) -> Path:
    """Return the folder of a module with two kernels."""
    (tmp_path / "code").mkdir()
    (tmp_path / "code" / "own_kernels.py").write_text(_MODULE)
    return tmp_path / "code"


def _run(module: Path, code: str = _CALL, **environment: str) -> tuple[str, str]:
    path = os.pathsep.join([str(module), *sys.path])
    environment = (
        os.environ
        | {"PYTHONPATH": path, "XDG_CACHE_HOME": str(module.parent / "home"), "NUMBA_CACHE_DIR": ""}
        | environment
    )
    done = subprocess.run(
        [sys.executable, "-B", "-c", code],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip(), done.stderr


def test_code_is_stored_beside_the_function_and_read_from_read_only_folders(module: Path):
    assert _run(module) == ("7.0 0 1", "")
    kept = module / "__pycache__"
    kept.chmod(0o555)
    try:
        assert _run(module, XDG_CACHE_HOME="/dev/null") == ("7.0 1 0", "")
    finally:
        kept.chmod(0o755)


def test_code_of_read_only_folders_is_stored_in_the_users_cache(module: Path):
    (module / "__pycache__").write_text("no folder")
    assert _run(module) == ("7.0 0 1", "")
    assert _run(module) == ("7.0 1 0", "")
    assert list(
        (module.parent / "home" / "topoloc" / "kernels").glob("code_*/own_kernels.more-*.nbi")
    )


def test_without_a_writable_folder_it_is_compiled_each_time_with_one_warning(module: Path):
    (module / "__pycache__").write_text("no folder")
    (module / "others").mkdir()
    (module / "others" / "__init__.py").write_text("")
    (module / "others" / "__pycache__").write_text("no folder")
    (module / "others" / "far_kernels.py").write_text(_MODULE)
    code = f"import others.far_kernels as f; f.more(1.0); {_CALL}"
    printed, said = _run(module, code, XDG_CACHE_HOME="/dev/null")
    assert printed == "7.0 0 1"
    assert said.startswith("topoloc compiles anew in every process")
    assert said.count("\n") == 1


def test_numbas_own_setting_is_kept(module: Path):
    folder = module.parent / "named"
    assert _run(module, NUMBA_CACHE_DIR=str(folder)) == ("7.0 0 1", "")
    assert _run(module, NUMBA_CACHE_DIR=str(folder)) == ("7.0 1 0", "")
    assert not (module / "__pycache__").exists()


@pytest.mark.parametrize("kind", ["nbi", "nbc"])
def test_damaged_code_is_made_again(module: Path, kind: str):
    _run(module)
    for file in (module / "__pycache__").glob(f"*.{kind}"):
        file.write_bytes(file.read_bytes()[:20])
    assert _run(module, XDG_CACHE_HOME="/dev/null") == ("7.0 0 1", "")
    assert _run(module, XDG_CACHE_HOME="/dev/null") == ("7.0 1 0", "")


def test_is_cached_reports_stored_code(module: Path):
    asks = (
        "from topoloc.compiled import is_cached; import own_kernels;"
        " print(is_cached(own_kernels.more))"
    )
    assert _run(module, asks)[0].splitlines()[-1] == "False"
    _run(module)
    assert _run(module, asks)[0].splitlines()[-1] == "True"
    for file in (module / "__pycache__").glob("*.nbi"):
        file.write_bytes(b"?")
    assert _run(module, asks)[0].splitlines()[-1] == "False"


def test_a_changed_kernel_beside_it_makes_it_another(module: Path):
    _run(module)
    (module / "own_kernels.py").write_text(_MODULE.replace("2.0 * x", "5.0 * x"))
    assert _run(module) == ("16.0 0 1", "")


def test_no_kernel_uses_numbas_own_threads():
    """If several Python threads use Numba's threads at once, Numba ends the process."""
    import topoloc.localization.localizer  # noqa: F401

    with pytest.raises(ValueError, match="parallel"):
        kernel(parallel=True)
    assert len(KERNELS) > 20
    assert [
        k for k in KERNELS if k.targetoptions.get("parallel") or not k.targetoptions["nogil"]
    ] == []


def test_a_number_of_threads_is_taken_and_changes_no_feature():
    code = (
        "import sys, numpy as np, topoloc, cv2\n"
        "from topoloc.features.extraction import FeatureConfig, extract_features\n"
        "picture = np.random.default_rng(0).integers(0, 255, (200, 200), np.uint8)\n"
        "first = extract_features(picture, FeatureConfig())\n"
        "for number in (1, 3):\n"
        "    topoloc.set_num_threads(number)\n"
        "    again = extract_features(picture, FeatureConfig())\n"
        "    assert again.descriptors.tobytes() == first.descriptors.tobytes() and len(again)\n"
        "    print(cv2.getNumThreads())\n"
        "try:\n    topoloc.set_num_threads(0)\n"
        "except ValueError as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.splitlines() == [
        "1",
        "3",
        "at least one thread is needed, not 0",
    ], done.stderr


def test_kernels_need_no_scipy():
    """Numba compiles matrix products and numpy.linalg with SciPy, which topoloc
    does not install."""
    import topoloc.slam.bundle.bundle_kernels  # noqa: F401 # declares kernels

    assert len(KERNELS) > 10
    for one in KERNELS:
        tree = ast.parse(dedent(inspect.getsource(one.py_func)))
        products = [node for node in ast.walk(tree) if isinstance(node, ast.MatMult)]
        names = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
        assert not products, one.__name__
        assert not names & {"dot", "vdot", "linalg"}, one.__name__
