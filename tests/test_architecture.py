"""The walls of the house: layers, the rules for kernels, and what no installed module may do."""

from __future__ import annotations

import ast
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import jaxtyping
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent
PRODUCT = ("sfm", "calib", "stereo")
FILES = sorted(file for package in PRODUCT for file in (ROOT / package).rglob("*.py"))
NAMES = [str(file.relative_to(ROOT)) for file in FILES]
every_module = pytest.mark.parametrize("file", FILES, ids=NAMES)

COMPILERS = {"njit", "jit", "vectorize", "guvectorize", "cfunc", "stencil", "generated_jit"}
# Seconds to import, or an extra that may not be installed.
LAZY = {"open3d", "rerun", "trimesh", "dask", "distributed", "matplotlib", "h5py", "pycolmap"}
IMPURE = {"random", "time", "datetime", "logging", "socket", "sqlite3", "subprocess", "tempfile", "shutil", "urllib"}
UNTOLD = {"utils", "util", "helpers", "misc", "common"}


def imported(tree: ast.AST) -> Iterator[str]:
    """Names of all modules that a tree imports, at its top or within."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module


def imported_at_top(tree: ast.Module) -> set[str]:
    """First names of the modules that are imported as soon as the module is; those for types only do not count."""
    top = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
    return {name.split(".")[0] for node in top for name in imported(node)}


def name_of(node: ast.expr) -> str:
    """`a.b.c` of a name or a chain of attributes; empty for other expressions."""
    if isinstance(node, ast.Attribute):
        return f"{name_of(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def calls(tree: ast.AST) -> Iterator[tuple[str, dict[str, object]]]:
    """The dotted name and the constant keywords of every call."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            yield name_of(node.func), {k.arg: getattr(k.value, "value", ...) for k in node.keywords if k.arg}


def compiled(tree: ast.AST) -> Iterator[ast.expr]:
    """What names a compiler of Numba, decorator or not."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name | ast.Attribute) and name_of(node).split(".")[-1] in COMPILERS:
            yield node


def faults(tree: ast.Module, path: str) -> list[str]:
    """What is wrong with the module at `path`, in words."""
    stem = Path(path).stem
    found = []
    if not ast.get_docstring(tree):
        found.append("has no docstring")
    if stem in UNTOLD:
        found.append("has a name that tells nothing")
    if {name.split(".")[0] for name in imported(tree)} & {"datasets", "tests"}:
        found.append("imports development data")
    if imported_at_top(tree) & LAZY:
        found.append(f"imports {imported_at_top(tree) & LAZY} at its top")
    if path.startswith("sfm/core/") and {name.split(".")[0] for name in imported(tree)} & IMPURE:
        found.append("core is not pure")
    return found + kernel_faults(tree, stem) + unsafe(tree)


def extends_numba(node: ast.FunctionDef) -> bool:
    """Whether a function tells numba how to compile another."""
    names = [name_of(d.func if isinstance(d, ast.Call) else d) for d in node.decorator_list]
    return names in (["intrinsic"], ["overload"])


def kernel_faults(tree: ast.Module, stem: str) -> list[str]:
    """Breaches of the rules for kernels."""
    if not stem.endswith("_kernels"):
        return ["compiles outside a module named *_kernels"] if any(compiled(tree)) else []
    found = [] if stem.startswith("_") else ["a module of kernels is private"]
    for node in ast.walk(tree):
        # A function without decorator runs once, at import, and builds a table of constants; or is the plain form
        # of one that is written out for the compiler.
        if isinstance(node, ast.FunctionDef) and node.decorator_list and not extends_numba(node):
            settings = [d for d in node.decorator_list if isinstance(d, ast.Call) and name_of(d.func).endswith("njit")]
            if len(node.decorator_list) != 1 or not settings:
                found.append(f"{node.name} is not decorated by njit(...) alone")
            elif settings[0].args:
                found.append(f"{node.name} has an explicit signature, which refuses read-only arrays")
            else:
                keywords = {k.arg: getattr(k.value, "value", None) for k in settings[0].keywords}
                if not (keywords.get("cache") and keywords.get("nogil")) or keywords.get("parallel"):
                    found.append(f"{node.name} must be cached, without the GIL and not parallel")
    return found


def unsafe(tree: ast.Module) -> list[str]:
    """Ways to run code that comes with data, and to listen to the network."""
    found = []
    for name, keywords in calls(tree):
        if name in ("pickle.load", "pickle.loads", "pickle.Unpickler", "eval", "exec", "os.system", "yaml.load"):
            found.append(f"calls {name}")
        if keywords.get("shell") not in (None, False) or keywords.get("allow_pickle") not in (None, False):
            found.append(f"calls {name} with shell or allow_pickle")
    if "pickle" in imported_at_top(tree) and any(
        isinstance(node, ast.ImportFrom) and node.module == "pickle" for node in ast.walk(tree)
    ):
        found.append("imports from pickle")
    texts = (node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str))
    if any("0.0.0.0" in text for text in texts):
        found.append("names the address of all interfaces")
    return found


@every_module
def test_a_module_keeps_the_rules_of_the_house(file):
    assert faults(ast.parse(file.read_text()), file.relative_to(ROOT).as_posix()) == []


@pytest.mark.parametrize(
    ("path", "source", "fault"),
    [
        ("sfm/io/x.py", "x = 1", "has no docstring"),
        ("sfm/io/utils.py", "'''D.'''", "tells nothing"),
        ("sfm/io/x.py", "'''D.'''\ndef f():\n    from datasets.synthetic import orbit", "development data"),
        ("sfm/viz/x.py", "'''D.'''\nimport rerun as rr", "at its top"),
        ("sfm/core/x.py", "'''D.'''\nimport time", "not pure"),
        ("sfm/core/x.py", "'''D.'''\nfrom numba import njit\n@njit\ndef f(): ...", "compiles outside"),
        ("sfm/core/x.py", "'''D.'''\nimport numba\nf = numba.njit(cache=True)(g)", "compiles outside"),
        ("sfm/core/x_kernels.py", "'''D.'''", "is private"),
        ("sfm/core/_kernels.py", "'''D.'''\n@njit(cache=True)\ndef f(): ...", "without the GIL"),
        (
            "sfm/core/_kernels.py",
            "'''D.'''\n@njit(cache=True, nogil=True, parallel=True)\ndef f(): ...",
            "not parallel",
        ),
        ("sfm/core/_kernels.py", "'''D.'''\n@njit('f8(f8)', cache=True, nogil=True)\ndef f(): ...", "signature"),
        ("sfm/core/_kernels.py", "'''D.'''\n@njit\ndef f(): ...", "njit"),
        ("sfm/io/x.py", "'''D.'''\nimport pickle\npickle.load(f)", "calls pickle.load"),
        ("sfm/io/x.py", "'''D.'''\nfrom pickle import load", "imports from pickle"),
        ("sfm/io/x.py", "'''D.'''\nsubprocess.run(c, shell=True)", "with shell"),
        ("sfm/io/x.py", "'''D.'''\nnp.load(f, allow_pickle=True)", "allow_pickle"),
        ("sfm/viz/x.py", "'''D.'''\nserve(f'http://0.0.0.0:{port}')", "all interfaces"),
    ],
)
def test_a_breach_of_a_rule_is_found(path, source, fault):
    found = faults(ast.parse(source), path)
    assert len(found) == 1
    assert fault in found[0]


def test_what_the_rules_allow_is_not_found():
    lazy = "'''D.'''\ndef f():\n    import rerun\n    return subprocess.run(c, shell=False)"
    assert faults(ast.parse(lazy), "sfm/viz/x.py") == []
    kernel = "'''D.'''\nfrom numba import njit\n@njit(cache=True, nogil=True)\ndef f(): ..."
    assert faults(ast.parse(kernel), "sfm/core/_x_kernels.py") == []


def lint_imports(folder: Path) -> subprocess.CompletedProcess[str]:
    """Runs the contracts of `pyproject.toml` on the packages in `folder`."""
    run = "from importlinter.cli import lint_imports_command as run; run()"
    return subprocess.run(
        [sys.executable, "-c", run, "--no-cache", "--no-logo"], cwd=folder, capture_output=True, text=True, check=False
    )


def test_the_import_contracts_hold():
    result = lint_imports(ROOT)
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.fixture(scope="module")
def copied_tree(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tree")
    for package in (*PRODUCT, "datasets"):
        shutil.copytree(
            ROOT / package, folder / package, ignore=lambda _, names: [n for n in names if n == "__pycache__"]
        )
    shutil.copy(ROOT / "pyproject.toml", folder)
    return folder


@pytest.mark.parametrize(
    ("importer", "imports"),
    [
        ("sfm/core/geometry/breach.py", "sfm.core.scene"),
        ("sfm/core/graphs/breach.py", "sfm.core.geometry.rigid"),
        ("sfm/bundle/breach.py", "sfm.io"),
        ("sfm/matching/breach.py", "sfm.features"),
        ("sfm/mapping/breach.py", "pycolmap"),
        ("calib/breach.py", "sfm.mapping"),
        ("stereo/breach.py", "calib"),
        ("sfm/pipeline/breach.py", "sfm.cli"),
        ("sfm/io/breach.py", "datasets"),
    ],
)
def test_a_breach_of_a_contract_is_found(copied_tree, importer, imports):
    """Within a function too, since that is how a border is crossed in a hurry."""
    breach = copied_tree / importer
    breach.write_text(f"def f():\n    import {imports}\n    return {imports}\n")
    try:
        result = lint_imports(copied_tree)
    finally:
        breach.unlink()
    assert result.returncode == 1, result.stdout + result.stderr
    assert "breach" in result.stdout
    assert "BROKEN" in result.stdout


@pytest.mark.parametrize("command", [["check"], ["format", "--check"]], ids=" ".join)
def test_ruff_is_content(command):
    result = subprocess.run(
        [sys.executable, "-m", "ruff", *command, "--no-cache", "."],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr


def test_shapes_in_signatures_are_checked_in_this_run():
    from sfm.core.geometry.triangulation import triangulate_midpoint
    from sfm.core.scene import Matches

    with pytest.raises(jaxtyping.TypeCheckError, match="rays2"):
        triangulate_midpoint(_identity(), np.zeros((4, 3)), np.zeros((5, 3)))
    with pytest.raises(jaxtyping.TypeCheckError, match="indices"):
        Matches(np.zeros((2, 3), np.int32))


def _identity():
    from sfm.core.geometry.rigid import Rigid3

    return Rigid3.identity()
