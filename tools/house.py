#!/usr/bin/env python3
"""The structure of topoloc in figures: house.py ROOT [--run] [--json FILE] [--show FIGURE]

Prints each figure's name and value, or `-` and the reason; --show lists what a figure counts;
--json writes {name: value or null, ..., "reasons": {name: why there is none}}.
FILES: ROOT/src/topoloc/**/*.py. --run also runs the project: some minutes; it needs ROOT/.venv.
APPS: the files in apps/ and demo/; while there is no apps/, those that will move there, too
(APPS_TODAY below). CORE: the others. ROOM: core/X or apps/X, X the first folder below topoloc/
(in apps/ the second).
FORMATTED: a copy after `ruff format --isolated --line-length 100 --target-version py311`, by
ROOT/.venv/bin/ruff, else by that of PATH. Everywhere a line of n characters counts ceil(n / 100).
"""

import argparse
import ast
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter, defaultdict
from pathlib import Path

FUNCTION, DOORS = (ast.FunctionDef, ast.AsyncFunctionDef), ("topoloc", "topoloc.plugin")
NOT_OURS = {"tests", "build", "dist", "_build", "node_modules", "__pycache__"}
APPS_TODAY = """(cli|service|viewer|export|cluster|sequences/(bags|capture))/|sequences/(nerfstudio
    |record3d|colmap|colmap_database|zed|svo|stereo_yaml|yaml_numbers|known_distances|live)[.]
    |atlas/(object_store|tile_fetches|watched_atlas)[.]
    |evaluation/(?!__init__|metrics|experiments|world_fit)"""
IS_ATLAS = re.compile(r"_?(is|are|has)_(\w+_)?(atlas|atlases|tiled|tiles)")
OWN_CONFIG = """import importlib.metadata as metadata, sys
every, sys.argv[1:] = metadata.entry_points, ["config"]
metadata.entry_points = lambda **which: [e for e in every(**which) if e.dist.name == "topoloc"]
(script,) = every(group="console_scripts", name="topoloc"); sys.exit(script.load()())"""
LOADED = """
import json, sys
heavy = [m for m in ("cv2", "numba", "torch", "faiss", "onnxruntime") if m in sys.modules]
ours = [m.__file__ for name, m in sys.modules.items() if name.startswith("topoloc.")]
print(json.dumps([heavy, ours]))"""
ANSWER = """
import json, sys, topoloc; from pathlib import Path
lab = Path(topoloc.__file__).parent / "demo" / "lab"
opened = getattr(topoloc, "open_sequence", None) or topoloc.open_recording
try: localizer = topoloc.Localizer(topoloc.TopoMetricMap.load(sys.argv[1]))
except AttributeError: localizer = topoloc.Localizer(sys.argv[1])
day, other = opened(lab / "day"), opened(lab / "corridor")
localizer.localize(day[0].image, day[0].camera)"""
QUERIES = (
    ANSWER
    + """
def asked(image, camera):
    files, changes, last = set(), 0, None
    def look(frame, event, _):
        nonlocal changes, last
        frame = frame.f_back if event == "return" else frame if event == "call" else None
        file = frame.f_code.co_filename if frame else ""
        if file.startswith(str(lab.parent.parent)):
            files.add(file); changes += file != last; last = file
    sys.setprofile(look)
    try: result = localizer.localize(image, camera)
    finally: sys.setprofile(None)
    return len(files), changes, not type(result).__name__.startswith("Not")
for i in (1, 3): localizer.localize(day[i].image, day[i].camera)
frames = [day[2], *(other[i] for i in range(len(other)))]
print(json.dumps([[asked(f.image, f.camera) for _ in range(2)] for f in frames]))"""
)
REACHED = {"localizer": "from topoloc import Localizer", "result": "topoloc.Localization",
           "map": "topoloc.TopoMetricMap", "client": "import topoloc; topoloc.Client",
           "answer": ANSWER}  # fmt: skip


class House:
    """A checkout: the trees of the package's files, by short path, and of the others but tests."""

    def __init__(self, root, cache):
        self.root, self.src, self.cache = root, root / "src" / "topoloc", cache
        trees = {p: tree for p in found(root, ".py") if (tree := parsed(p)) is not None}
        self.files = {p.relative_to(self.src): t for p, t in trees.items() if self.src in p.parents}
        self.others = {path: tree for path, tree in trees.items() if self.src not in path.parents}
        names = {short: ".".join(("topoloc", *short.with_suffix("").parts)) for short in self.files}
        self.modules = {name.removesuffix(".__init__"): short for short, name in names.items()}
        today = "" if (self.src / "apps").is_dir() else "|" + "".join(APPS_TODAY.split())
        self.apps = re.compile(f"(apps|demo)/{today}")

    def room(self, short):
        side = "apps" if self.apps.match(short.as_posix()) else "core"
        return f"{side}/{[*short.parts[:-1], '(root)'][short.parts[0] == 'apps']}"

    def run(self, program, *arguments):
        """Return the output of a program of ROOT/.venv."""
        command = [self.root / ".venv" / "bin" / program, *arguments]
        env = os.environ | {"PYTHONPATH": str(self.root / "src")}
        given = {"capture_output": True, "text": True, "cwd": self.cache, "timeout": 1200}
        done = subprocess.run(command, env=env, **given)
        if done.returncode:
            raise RuntimeError(done.stderr.strip()[-130:])
        return done.stdout

    def taken(self, short):
        """Yield the (module, name) pairs that a file imports; an empty name means the module."""
        for node in ast.walk(self.files[short]):
            pairs = []
            if isinstance(node, ast.Import):
                pairs = [(alias.name, "") for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                above = ("topoloc", *short.parts)[: -node.level] if node.level else ()
                base = ".".join([*above, *filter(None, [node.module])])
                full = [f"{base}.{alias.name}" for alias in node.names]
                pairs = [(f, "") if f in self.modules else f.rsplit(".", 1) for f in full]
            elif isinstance(node, ast.Attribute):  # topoloc.Localizer, plugin.Recording
                module, _, name = ast.unparse(node).rpartition(".")
                module = {"plugin": DOORS[1]}.get(module, module)
                pairs = [(module, name)] if module in DOORS else []
            known = self.modules
            yield from ((m, n) for m, n in pairs if m in known and f"{m}.{n}" not in known)


def found(folder, *suffixes):
    """Yield files below a folder with one of these suffixes; skip tests, hidden and built files."""
    for where, folders, names in os.walk(folder):
        folders[:] = sorted(f for f in folders if f not in NOT_OURS and not f.startswith("."))
        yield from (Path(where, name) for name in sorted(names) if name.endswith(suffixes))


def parsed(path):
    try:
        return ast.parse(path.read_bytes())
    except (SyntaxError, ValueError) as error:
        return print(f"left out: {path}: {error}", file=sys.stderr)


def costs(path):
    return [max(1, -(-len(line) // 100)) for line in path.read_text("utf-8").splitlines()]


def is_bare(node):
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def name_of(node):
    """The name that is read, set or given; of a dotted one the last part."""
    return next(filter(None, (getattr(node, a, None) for a in ("attr", "id", "arg"))), "")


def tested(node):
    """Names of the classes that isinstance, issubclass, `case` test for; texts of comparisons."""
    if isinstance(node, ast.Call) and name_of(node.func) in ("isinstance", "issubclass"):
        return [name_of(n) for argument in node.args[1:] for n in ast.walk(argument)]
    if isinstance(node, ast.Compare):
        return [str(n.value) for n in ast.walk(node) if isinstance(n, ast.Constant)]
    return [name_of(node.cls)] if isinstance(node, ast.MatchClass) else []


def definitions(node, is_public=True):
    """Functions and classes below a node that are in no function, and whether they are public."""
    for child in ast.iter_child_nodes(node):
        is_named = isinstance(child, (ast.ClassDef, *FUNCTION))
        is_shown = is_public and not (is_named and child.name.startswith("_"))
        if is_named:
            yield child, is_shown
        if not isinstance(child, (ast.Lambda, *FUNCTION)):
            yield from definitions(child, is_shown)


def sizes(house):
    """
    lines.core .apps .all .ROOM    lines, formatted
    files_over_300                 files of more than 300 lines, formatted
    functions_over_45              functions, nested ones too, of more than 45 lines, formatted,
        from the first statement after the docstring to the end
    """
    ruff = shutil.which("ruff", path=f"{house.root}/.venv/bin{os.pathsep}{os.environ['PATH']}")
    options = "format --isolated --no-cache --quiet --line-length 100 --target-version py311"
    rooms, large, long = Counter(), [], []
    with tempfile.TemporaryDirectory() as folder:
        for short in house.files:
            (Path(folder) / short).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(house.src / short, Path(folder) / short)
        subprocess.run([ruff or "ruff", *options.split(), folder], check=True)
        for short in house.files:
            cost = costs(Path(folder) / short)
            rooms[house.room(short)] += sum(cost)
            large += [f"{short} {sum(cost)}"] * (sum(cost) > 300)
            for node in ast.walk(ast.parse((Path(folder) / short).read_bytes())):
                if isinstance(node, FUNCTION):
                    body = node.body[ast.get_docstring(node) is not None :] or node.body
                    size = sum(cost[body[0].lineno - 1 : body[-1].end_lineno])
                    long += [f"{short} {node.name} {size}"] * (size > 45)
    for side, start in (("core", "core"), ("apps", "apps"), ("all", "")):
        yield f"lines.{side}", sum(n for room, n in rooms.items() if room.startswith(start))
    yield from (("files_over_300", large), ("functions_over_45", long))
    yield from ((f"lines.{room}", number) for room, number in sorted(rooms.items()))


def code(house):
    """
    statements.core .apps          ast.stmt nodes but bare constants (docstrings, `...`)
    statements.elsewhere           the same of ROOT's other .py files but tests
    documented %                   public functions, methods, classes with a docstring; public: in
        no function, and no _ before its name or that of a class around it
    typed %                        functions and methods, private too, in no function, with
        annotations of the return and of all arguments but self and cls
    folders_over_20                folders with more than 20 .py files directly in them
    """
    statements, shares, folders = Counter(), defaultdict(list), Counter()
    for path, tree in (house.files | house.others).items():
        side = house.room(path)[:4] if path in house.files else "elsewhere"
        nodes = [n for n in ast.walk(tree) if isinstance(n, ast.stmt) and not is_bare(n)]
        statements[side] += len(nodes)
    for short, tree in house.files.items():
        folders[short.parent.as_posix()] += 1
        for node, is_public in definitions(tree):
            if is_public:
                shares["documented %"].append(ast.get_docstring(node) is not None)
            if isinstance(node, FUNCTION):
                a, more = node.args, (node.args.vararg, node.args.kwarg)
                given = [*a.posonlyargs, *a.args, *a.kwonlyargs, *filter(None, more)]
                notes = [x.annotation for x in given if x.arg not in ("self", "cls")]
                shares["typed %"].append(None not in [*notes, node.returns])
    yield from ((f"statements.{side}", statements[side]) for side in ("core", "apps", "elsewhere"))
    yield from ((k, round(100 * sum(held) / len(held), 1)) for k, held in sorted(shares.items()))
    yield "folders_over_20", [f"{folder} {n}" for folder, n in folders.items() if n > 20]


def imports(house):
    """
    one_importer                   files but __init__.py that one other file alone imports (import
        statements anywhere in it)
    apps.public_names              names that apps take from `topoloc` and `topoloc.plugin`
    apps.deep_names .deep_modules  ... from other core modules, whole modules too; these modules
    """
    users, names = defaultdict(set), defaultdict(set)
    for short in house.files:
        for module, name in house.taken(short):
            used = house.modules[module]
            users[used] |= {short} - {used}
            if house.room(short)[:4] == "apps" and house.room(used)[:4] == "core":
                names[module in DOORS].add((module, name))
    one = [(p, by) for p, by in users.items() if len(by) == 1 and p.name != "__init__.py"]
    yield "one_importer", [f"{path} <- {min(by)}" for path, by in one]
    yield "apps.public_names", {".".join(pair) for pair in names[True] if pair[1]}
    yield "apps.deep_names", {".".join(filter(None, pair)) for pair in names[False]}
    yield "apps.deep_modules", {module for module, _ in names[False]}


def habits(house):
    """
    asserts.not_none .casts        assert statements with `is not None`; calls of `cast`
    asserts.ignores .sum           lines with `# pyright: ignore`, `# type: ignore`; all three
    branches.map_or_atlas          calls of is_*, are_*, has_* with a name that ends in atlas,
        atlases, tiled, tiles; tests (isinstance, issubclass, `case`) of a class Localizer, *Atlas*
    branches.walls                 in files without `wall` in their path: attributes and arguments
        is_from_*, tests of a class *Wall*, comparisons with a text *wall*
    constants.all .ROOM            ALL_CAPS names that the top level of a module binds to a value
        with a number and no text
    """
    rows, constants = defaultdict(list), defaultdict(list)
    for short, tree in house.files.items():
        for number, line in enumerate((house.src / short).read_text("utf-8").splitlines(), 1):
            is_ignore = re.search(r"#\s*(pyright|type):\s*ignore", line)
            rows["asserts.ignores"] += [f"{short}:{number}"] * bool(is_ignore)
        for node in ast.walk(tree):
            where = [f"{short}:{getattr(node, 'lineno', '')} {name_of(node)}"]
            called, texts = name_of(getattr(node, "func", None)), " ".join(tested(node))
            is_given = isinstance(node, (ast.Attribute, ast.keyword))
            is_assert = isinstance(node, ast.Assert) and "is not None" in ast.unparse(node.test)
            is_atlas = IS_ATLAS.fullmatch(called) or re.search(r"\bLocalizer\b|Atlas", texts)
            is_wall = (is_given and name_of(node).startswith("is_from_")) or "wall" in texts.lower()
            rows["asserts.not_none"] += where * is_assert
            rows["asserts.casts"] += where * (called == "cast")
            rows["branches.map_or_atlas"] += where * bool(is_atlas)
            rows["branches.walls"] += where * (is_wall and "wall" not in short.as_posix())
        for node in tree.body:
            if isinstance(node, (ast.Assign, ast.AnnAssign)) and node.value:
                kinds = {type(getattr(n, "value", None)) for n in ast.walk(node.value)}
                stored = [n for n in ast.walk(node) if isinstance(getattr(n, "ctx", 0), ast.Store)]
                caps = [n for n in map(name_of, stored) if re.fullmatch(r"_?[A-Z0-9_]+", n)]
                if caps and kinds & {int, float} and str not in kinds:
                    constants[house.room(short)] += [f"{short} {name}" for name in caps]
    rows["asserts.sum"] = [row for name in sorted(rows) if "asserts" in name for row in rows[name]]
    yield from sorted(rows.items())
    yield "constants.all", sum(map(len, constants.values()))
    yield from ((f"constants.{room}", caps) for room, caps in sorted(constants.items()))


def pages(house):
    """
    user_docs_bytes                .md and .rst files in docs/, but with `journal` in their path
    readme_lines                   README.md
    architecture_lines             docs/architecture.md
    """
    docs = [p for p in found(house.root / "docs", ".md", ".rst") if "journal" not in str(p)]
    yield "user_docs_bytes", sum(path.stat().st_size for path in docs)
    yield "readme_lines", sum(costs(house.root / "README.md"))
    yield "architecture_lines", sum(costs(house.root / "docs" / "architecture.md"))


def keys_of(text):
    """The (section, key) of a TOML text, those of `# key =`, too."""
    section = ""
    for line in text.splitlines():
        if table := re.match(r"\[([\w.]+)\]", line):
            section = table[1]
        elif key := re.match(r"(?:# )?([a-z]\w*) =(?: |$)", line):
            yield section, key[1]


def settings(house):
    """
    settings.printed               `[section] key`, also `# key =`, of what `topoloc config` prints
    settings.product               ... without tables that other installed distributions bring
    settings.never_set             of these, those that nobody sets. Somebody is, but for tests:
        (1) in a .py file of ROOT, `key=` in a call of the section's class (the one whose annotated
        fields are just its keys and tables; without one, any class) or of *replace; (2) in a .py
        file in a folder `cli`, a text that is the key or the end of its path ("nodes.d_thresh");
        (3) the path in a .toml file; (4) `key =` in code in README.md or docs/, but in journal,
        changelog, and pages with a third of all keys, which are references
    """
    yield "settings.printed", {".".join(pair) for pair in keys_of(house.run("topoloc", "config"))}
    keys = set(keys_of(house.run("python", "-c", OWN_CONFIG)))
    yield "settings.product", {".".join(pair) for pair in keys}
    parts, classes, calls, texts = defaultdict(set), defaultdict(set), set(), set()
    for section, key in keys:
        parts[section].add(key)
        parts[section.rpartition(".")[0]].add(section.rpartition(".")[2])
    for path, tree in (house.files | house.others).items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                fields = {name_of(n.target) for n in node.body if isinstance(n, ast.AnnAssign)}
                classes[frozenset(fields)].add(node.name)
            elif isinstance(node, ast.Call):
                name = re.sub(".*replace$", "replace", name_of(node.func))
                calls |= {(name, keyword.arg) for keyword in node.keywords}
            elif isinstance(node, ast.Constant) and "cli" in path.parts:
                texts.add(str(node.value))
    for path in found(house.root, ".toml"):
        given = re.sub("(?m)^#.*", "", path.read_text("utf-8"))
        texts |= {".".join(pair) for pair in keys_of(given)}
    names, shown = {key for _, key in keys}, set()
    for path in [house.root / "README.md", *found(house.root / "docs", ".md", ".rst")]:
        code = re.findall(r"```.*?```|`[^`\n]+`", path.read_text("utf-8"), re.S)
        named = names & set(re.findall(r"\b(\w+) ?=(?!=)", " ".join(code)))
        is_reference = len(named) > len(names) / 3 or re.search("journal|changelog", str(path))
        shown |= set() if is_reference else named
    everybody, unset = {name for name, _ in calls}, []
    for section, key in keys - {pair for pair in keys if pair[1] in shown}:
        path, owners = f"{section}.{key}", classes.get(frozenset(parts[section]), everybody)
        ends = {path.split(".", n)[-1] for n in range(path.count(".") + 1)}
        is_set = ends & texts or calls & {(owner, key) for owner in (*owners, "replace")}
        unset += [] if is_set else [path]
    yield "settings.never_set", unset


def lab_map(house):
    """The demo lab's map; made again when the package's code has changed."""
    texts = b"".join((house.src / short).read_bytes() for short in house.files)
    file = house.cache / f"lab-{hashlib.sha256(texts).hexdigest()[:12]}.topo"
    laps = [house.src / "demo" / "lab" / lap for lap in ("map_lap1", "map_lap2")]
    if not file.exists():
        house.run("topoloc", "build", *laps, file)
    return file


def reach(house, name, program):
    """
    reach.localizer                modules of topoloc in sys.modules of a fresh process, but
        `topoloc` and bare __init__.py, after `from topoloc import Localizer`
    reach.result .map              ... after import of the module that topoloc.Localization is of;
        that topoloc.TopoMetricMap is of
    reach.client .answer           ... after `topoloc.Client`; after the demo lab's map is loaded
        and image 0 of lab/day localized
    heavy.*                        how many of cv2, numba, torch, faiss, onnxruntime are loaded then
    """
    if program.startswith("topoloc."):
        module = house.run("python", "-c", f"import topoloc; print({program}.__module__)")
        program = f"import {module}"
    arguments = [lab_map(house)] if name == "answer" else []
    heavy, files = json.loads(house.run("python", "-c", program + LOADED, *arguments))
    bodies = {file: ast.parse(Path(file).read_bytes()).body for file in files if file}
    is_hollow = {f: f.endswith("__init__.py") and all(map(is_bare, bodies[f])) for f in bodies}
    yield f"reach.{name}", [file for file in bodies if not is_hollow[file]]
    yield f"heavy.{name}", heavy


def queries(house):
    """
    query.clear_files .clear_changes      image 2 of lab/day is localized a second time, after
        images 0, 1, 3: files of topoloc entered; changes of file (sys.setprofile of the calling
        thread): at a call the file called, at a return the file returned to, other files left out
    query.refused_files .refused_changes  the largest of all images of lab/corridor, another world,
        each the second time; all must be refused
    query.clear_first .refused_first      changes the first time, when nodes are read from the file
        (the map: `topoloc build` of lab/map_lap1 and map_lap2, kept in --cache DIR)
    """
    clear, *others = json.loads(house.run("python", "-c", QUERIES, lab_map(house)))
    for name, asked in (("clear", [clear]), ("refused", others)):
        if any(is_localized != (name == "clear") for _, (*_, is_localized) in asked):
            raise RuntimeError(f"an image that was to be {name} was not")
        yield f"query.{name}_files", max(again[0] for _, again in asked)
        yield f"query.{name}_changes", max(again[1] for _, again in asked)
        yield f"query.{name}_first", max(first[1] for first, _ in asked)


def names_of(function, name="", *_):
    """The figures that a function puts, as its docstring has them."""
    if name:
        return [f"reach.{name}", f"heavy.{name}"]
    rows = re.findall(r"^ {4}(\w+\.?)(\w+(?: %)?)((?: \.[a-z_]+)*) .*$", function.__doc__, re.M)
    return [room + x for room, first, more in rows for x in (first, *more.replace(".", "").split())]


def main():
    steps = [(function, ()) for function in (sizes, code, imports, habits, pages)]
    run = [(settings, ()), *((reach, pair) for pair in REACHED.items()), (queries, ())]
    texts = "".join(dict.fromkeys(function.__doc__ for function, _ in steps + run))
    style = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        usage=__doc__.splitlines()[0].partition(": ")[2],
        description=__doc__ + texts,
        formatter_class=style,
    )
    parser.add_argument("root", metavar="ROOT", type=Path)
    parser.add_argument("--run", action="store_true")
    for option in ("--json", "--show", "--cache"):
        parser.add_argument(option)
    args = parser.parse_args()
    if not (args.root / "src" / "topoloc").is_dir():
        parser.error(f"{args.root} has no src/topoloc")
    figures, reasons = {}, {}
    with tempfile.TemporaryDirectory() as folder:
        house = House(args.root.resolve(), Path(args.cache or folder).resolve())
        house.cache.mkdir(parents=True, exist_ok=True)
        for function, given in steps + run * args.run:
            try:
                figures.update(function(house, *given))
            except Exception as error:  # whatever it is, the other figures are wanted
                why = " ".join(f"{type(error).__name__}: {error}".split())[-150:]
                reasons |= {n: why for n in names_of(function, *given) if n not in figures}
                figures |= {n: None for n in reasons if n not in figures}
    values = {n: len(v) if isinstance(v, (list, set)) else v for n, v in figures.items()}
    for name, value in sorted(values.items(), key=lambda row: "/" in row[0]):  # rooms last
        print(f"{name:<30} {value if name not in reasons else '-  ' + reasons[name]}")
    if args.show:
        print("", *sorted(figures[args.show] or ()), sep="\n")
    if args.json:
        Path(args.json).write_text(json.dumps(values | {"reasons": reasons}, indent=1))


if __name__ == "__main__":
    main()
