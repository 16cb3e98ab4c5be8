#!/usr/bin/env python3
"""Build the four distributions for an index: release.py REPOSITORY [--out DIR]

REPOSITORY is the address of the repository on its host, such as https://github.com/OWNER/topoloc.
It is written into copies of the files of git: into `project.urls`, and before each relative link
and image of the READMEs, so that an index shows them. The tag of the release is v and the version.
"""

import argparse
import os
import posixpath
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
DISTRIBUTIONS = (".", "worlds", "training", "paper")
_LINK = re.compile(r"(?P<image>!?)(?P<text>\[[^\]]*\])\((?!\w+:|#)(?P<target>[^)\s]+)\)")


def copy_tree(target: Path) -> None:
    """Copy the files that git knows."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True)
    for name in filter(None, os.fsdecode(listed.stdout).split("\0")):
        if (ROOT / name).is_file():  # it may be removed and not committed
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, target / name)


def with_absolute_links(text: str, folder: str, address: str, tag: str) -> str:
    """Return a page whose links lead to the repository. `folder` is the page's own, in it."""

    def absolute(link: re.Match[str]) -> str:
        path, mark, place = link["target"].partition("#")
        path = posixpath.normpath(posixpath.join(folder, path))
        if not (ROOT / path).exists():
            sys.exit(f"error: {folder}/README.md: {link['target']}: no such file")
        kind = "raw" if link["image"] else "blob"
        return f"{link['image']}{link['text']}({address}/{kind}/{tag}/{path}{mark}{place})"

    return _LINK.sub(absolute, text)


def write_addresses(tree: Path, folder: str, address: str) -> None:
    """Write the addresses into the files of a distribution, and the licence beside them."""
    project = tree / folder / "pyproject.toml"
    text = project.read_text(encoding="utf-8")
    tag = f"v{tomllib.loads(text)['project']['version']}"
    urls = {
        "Homepage": address,
        "Documentation": f"{address}/blob/{tag}/docs/index.md",
        "Changelog": f"{address}/blob/{tag}/CHANGELOG.md",
        "Issues": f"{address}/issues",
    }
    lines = "".join(f'{name} = "{url}"\n' for name, url in urls.items())
    project.write_text(f"{text}\n[project.urls]\n{lines}", encoding="utf-8")
    readme = tree / folder / "README.md"
    page = with_absolute_links(readme.read_text(encoding="utf-8"), folder, address, tag)
    readme.write_text(page, encoding="utf-8")
    if folder != ".":
        shutil.copyfile(tree / "LICENSE", tree / folder / "LICENSE")


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("repository", metavar="REPOSITORY")
    parser.add_argument("--out", type=Path, default=ROOT / "dist", metavar="DIR")
    args = parser.parse_args()
    address = args.repository.rstrip("/")
    if not re.fullmatch(r"https://[\w.:-]+(/[\w.~-]+)+", address):
        sys.exit(
            f"error: {args.repository!r} is no address such as https://github.com/OWNER/topoloc"
        )
    out = args.out.absolute()
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder)
        copy_tree(tree)
        for name in DISTRIBUTIONS:
            write_addresses(tree, name, address)
            command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out)]
            done = subprocess.run([*command, tree / name], capture_output=True, text=True)
            if done.returncode:
                sys.exit(f"error: {name} cannot be built:\n{done.stdout}{done.stderr}")
    print(*sorted(path.name for path in out.iterdir()), sep="\n")


if __name__ == "__main__":
    main()
