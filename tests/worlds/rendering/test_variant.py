import json
import os
import sys
from pathlib import Path

import pytest

from topoloc.errors import MissingExtraError, TopolocError
from topoloc_worlds.rendering import variant


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "topoloc" / "llvm.json"


def test_kernels_lie_in_our_cache_unless_the_user_names_a_folder(monkeypatch, cache):
    monkeypatch.setenv("DRJIT_CACHE_DIR", "")
    variant._keep_kernels()
    assert os.environ["DRJIT_CACHE_DIR"] == str(cache.parent / "drjit")
    assert (cache.parent / "drjit").is_dir()
    monkeypatch.setenv("DRJIT_CACHE_DIR", "own")
    variant._keep_kernels()
    assert os.environ["DRJIT_CACHE_DIR"] == "own"


def test_missing_mitsuba_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(MissingExtraError, match=r"pip install mitsuba"):
        variant.use_best_variant()


def test_unknown_variant_is_refused():
    pytest.importorskip("mitsuba")
    with pytest.raises(TopolocError, match="unknown Mitsuba variant 'llvm_hd'"):
        variant.use_best_variant("llvm_hd")


def test_an_invalid_library_is_skipped_and_remembered(tmp_path, monkeypatch, cache, capfd):
    pytest.importorskip("mitsuba")
    bad = tmp_path / "libLLVM.so.99"
    bad.write_bytes(b"no library at all")
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(bad))
    assert variant.find_llvm() is None
    assert list(json.loads(cache.read_text()).values()) == [False]
    monkeypatch.setattr(variant, "_renders", lambda library: pytest.fail("probed twice"))
    assert variant.find_llvm() is None
    assert capfd.readouterr() == ("", "")


def test_an_unwritable_cache_only_costs_time(tmp_path, monkeypatch):
    pytest.importorskip("mitsuba")
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    library = tmp_path / "libLLVM.so.99"
    library.write_text("")
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(library))
    monkeypatch.setattr(variant, "_renders", lambda path: True)
    assert variant.find_llvm() == str(library)


def test_llvm_libraries_come_newest_first_and_none_too_old(tmp_path, monkeypatch):
    for name in (
        "libLLVM-15.so",
        "libLLVM-17.so",
        "libLLVM.so.19.1",
        "libLLVM-14.so.1",
        "libLLVMDemangle-18.so",
        "libLLVM-9.so",
    ):
        (tmp_path / name).write_text("")
    os.symlink(tmp_path / "libLLVM.so.19.1", tmp_path / "libLLVM-19.so")
    monkeypatch.setattr(variant, "_PLACES", (str(tmp_path / "libLLVM*"),))
    found = [os.path.realpath(path) for path in variant.installed_llvms()]
    assert found == [str(tmp_path / "libLLVM.so.19.1"), str(tmp_path / "libLLVM-17.so")]
