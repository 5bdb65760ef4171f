"""Every example in the README, the documentation and the docstrings runs, every link leads somewhere, and every
public name is described.
"""

from __future__ import annotations

import ast
import doctest
import gc
import importlib
import inspect
import pkgutil
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from seeds import shift_text

import scenecaptum
from scenecaptum.cli import parser

FLAGS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS

ROOT = Path(__file__).parents[2]
NAMES = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")
PAGES = [*(ROOT / name for name in NAMES), *sorted((ROOT / "docs").glob("*.md"))]
FENCE = re.compile(r"^```(\S*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
TORCHVISION = ("vision.md",)

MODULES = sorted(
    module.name
    for module in pkgutil.walk_packages(scenecaptum.__path__, "scenecaptum.")
    if "__main__" not in module.name
)

# Modules that users import by name; the other public names are those that packages re-export.
NAMED = ("scenecaptum.denoising", "scenecaptum.grid")


def blocks(page: Path) -> list[tuple[str, str]]:
    """Return the language and the text of each block of code."""
    return FENCE.findall(page.read_text())


def examples(page: Path) -> str:
    """Return a page's examples on their lines, without the prose."""

    def kept(block: re.Match[str]) -> str:
        code = block[2] if block[1] == "python" else "\n" * block[2].count("\n")
        return f"\n{code}\n"

    parts, end, text = [], 0, page.read_text()
    for block in FENCE.finditer(text):
        parts += ["\n" * text[end : block.start()].count("\n"), kept(block)]
        end = block.end()
    return "".join(parts)


@pytest.mark.parametrize("page", [one for one in PAGES if ">>>" in examples(one)], ids=lambda page: page.name)
def test_examples_of_pages_run(page, mi, request, monkeypatch):
    if page.name in TORCHVISION:
        models = request.getfixturevalue("torchvision").models
        build = models.get_model
        # The real weights would be a download.
        monkeypatch.setattr(models, "get_model", lambda name, weights: build(name))
    test = doctest.DocTestParser().get_doctest(
        examples(page), {"__name__": "__main__"}, page.name, str(page), 0
    )
    assert test.examples
    failures = failures_of(test)
    gc.collect()  # a live scene slows those of the next page
    assert not failures, failures


def failures_of(test: doctest.DocTest) -> str:
    """Run examples under this run's seeds, and return their failures."""
    failures: list[str] = []
    for example in test.examples:
        example.source = shift_text(example.source)
    doctest.DocTestRunner(optionflags=FLAGS).run(test, out=failures.append)
    return "".join(failures)


@pytest.mark.parametrize("name", MODULES)
def test_docstring_examples_run(name, mi):
    module = importlib.import_module(name)
    failures = [failures_of(test) for test in doctest.DocTestFinder().find(module)]
    assert not any(failures), "".join(failures)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_block_of_python_consists_of_examples(page):
    for language, code in blocks(page):
        assert language in ("python", "sh", "text", "toml", "{toctree}", "{eval-rst}", "{include}"), code
        if language == "python":
            assert ">>> " in code, f"{page.name} shows code that nobody runs:\n{code}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_in_pages_exist(page):
    for language, code in blocks(page):
        for line in code.replace("\\\n", " ").splitlines() if language == "sh" else ():
            check_command(shlex.split(line, comments=True))


def check_command(words: list[str]) -> None:
    match words:
        case ["scenecaptum", *arguments]:
            parser().parse_args(arguments)
        case ["make", *targets]:
            assert all(
                re.search(rf"^{one}:", (ROOT / "Makefile").read_text(), re.MULTILINE) for one in targets
            )
        case ["python", path, *_]:
            assert (ROOT / path).is_file() or (ROOT / path / "__main__.py").is_file(), path
        case ["pip", "install", what]:
            extras = re.findall(r"\[(\w+)\]", what)
            assert all(f"\n{one} = [" in (ROOT / "pyproject.toml").read_text() for one in extras), what
        case [] | [".", ".venv/bin/activate"]:
            pass
        case _:
            pytest.fail(f"nothing checks the command {shlex.join(words)}")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_relative_links_lead_somewhere(page):
    prose = FENCE.sub("", page.read_text())
    for link in re.findall(r"\]\(([^)\s]+)\)", prose):
        if not re.match(r"https?:", link):
            path, _, anchor = link.partition("#")
            target = page.parent / path if path else page
            assert target.exists(), f"{page.name}: {link}"
            assert not anchor or anchor in anchors(target), f"{page.name}: {link}"


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub and MyST make them."""
    headings = re.findall(r"^#+ (.*)$", FENCE.sub("", page.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_scripts_that_pages_name_exist(page):
    for path in re.findall(r"(?:benchmarks|examples|scripts)/[\w/-]+(?:\.(?:py|ipynb))?", page.read_text()):
        assert (ROOT / path).exists(), f"{page.name}: {path}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_pictures_have_alternative_text(page):
    prose = FENCE.sub("", page.read_text())
    assert all(len(text) > 10 for text in re.findall(r"!\[(.*?)\]\(", prose))


def test_drawings_are_those_of_the_script(tmp_path):
    subprocess.run([sys.executable, ROOT / "docs" / "drawings.py", tmp_path], check=True)
    drawn = {path.name for path in tmp_path.glob("*.svg")}
    assert drawn == {path.name for path in (ROOT / "docs" / "pictures").glob("*.svg")}
    assert drawn == {
        name for page in PAGES for name in re.findall(r"pictures/([\w-]+\.svg)\)", page.read_text())
    }


def test_every_picture_of_the_guides_follows_an_example_that_draws_it():
    sys.path.insert(0, str(ROOT / "docs"))
    from guide_pictures import steps

    stored = {path.name for path in (ROOT / "docs" / "pictures" / "guides").iterdir()}
    drawn = [Path(one).name for page in PAGES for _, one in steps(page) if one is not None]
    shown = [name for page in PAGES for name in re.findall(r"pictures/guides/([\w.-]+)\)", page.read_text())]
    assert sorted(drawn) == sorted(shown) == sorted(stored)


def test_the_citation_names_the_version():
    [version] = re.findall(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert version == scenecaptum.__version__


def public() -> Iterator[tuple[str, Any]]:
    """Return every public name with its object: what packages re-export, and the functions of two modules."""
    packages = {one.name for one in pkgutil.walk_packages(scenecaptum.__path__, "scenecaptum.") if one.ispkg}
    for name in sorted({"scenecaptum", *packages, *NAMED} - {"scenecaptum.cli"}):
        module = importlib.import_module(name)
        names = own_names(module) if name in NAMED else getattr(module, "__all__", re_exported(module))
        yield from ((f"{name}.{one}", getattr(module, one)) for one in names)


def re_exported(module: Any) -> list[str]:
    """Return the names that a package imports as themselves, modules aside."""
    imports = [node for node in ast.parse(inspect.getsource(module)).body if isinstance(node, ast.ImportFrom)]
    names = [alias.asname for node in imports for alias in node.names if alias.asname == alias.name]
    return [one for one in names if one and not inspect.ismodule(getattr(module, one))]


def own_names(module: Any) -> list[str]:
    """Return the names of the functions and classes that a module defines."""
    things = inspect.getmembers(module, inspect.isclass) + inspect.getmembers(module, inspect.isfunction)
    return [one for one, thing in things if one[0] != "_" and thing.__module__ == module.__name__]


def test_every_public_name_is_in_the_reference():
    listed = set(re.findall(r"scenecaptum(?:\.\w+)+", (ROOT / "docs" / "reference.md").read_text()))
    known = dict(public())
    assert not listed - known.keys(), "the reference lists what does not exist"
    shown = {id(known[name]) for name in listed}
    missing = [name for name, thing in known.items() if id(thing) not in shown]
    assert not missing, f"docs/reference.md leaves out {', '.join(missing)}"


def test_every_public_name_has_a_docstring():
    undocumented = [
        f"{name}{'.' if member else ''}{member}"
        for name, thing in public()
        if callable(thing)
        for member, part in [("", thing), *methods(thing)]
        if not (part.__doc__ or "").strip()
    ]
    assert not undocumented


def test_every_parameter_is_described():
    undescribed = [
        f"{name}{'.' if member else ''}{member}({parameter})"
        for name, thing in public()
        for member, part in [("", thing), *methods(thing)]
        for parameter in set(parameters(part)) - described(part)
    ]
    assert not undescribed


def test_pages_of_classes_show_the_parameters_of_their_constructors():
    """Sphinx takes the first of these three, whatever Python's own ``inspect.signature`` finds."""
    unnamed = {
        name
        for name, thing in public()
        if inspect.isclass(thing)
        for shown in [getattr(thing, "__signature__", None) or thing.__new__ or thing.__init__]
        if isinstance(shown, inspect.Signature) or inspect.isfunction(shown)
        for signature in [shown if isinstance(shown, inspect.Signature) else inspect.signature(shown)]
        if any(parameter.strip("_") == "" for parameter in signature.parameters)
    }
    assert not unnamed
    renderer = scenecaptum.SceneRenderer
    assert str(renderer.__signature__).startswith(
        "(scene: 'SceneLike', inputs: 'Selection' = 'materials', *, "
    )


def parameters(part: Any) -> list[str]:
    """Return what a docstring has to describe: a constructor's parameters, a tuple's fields, others from two on.

    A single parameter is covered by the summary. Exceptions are constructed by the library only.
    """
    part = getattr(part, "__func__", part)
    if not callable(part) or (inspect.isclass(part) and issubclass(part, BaseException)):
        return []
    if inspect.isclass(part) and issubclass(part, tuple):
        return list(part._fields)
    names = [name for name in inspect.signature(part).parameters if name not in ("self", "cls")]
    return names if inspect.isclass(part) or len(names) > 1 else []


def described(part: Any) -> set[str]:
    """Return the parameters and attributes that a docstring, or that of a base class, names."""
    docs = [one.__doc__ or "" for one in (inspect.getmro(part) if inspect.isclass(part) else [part])]
    entries = re.findall(
        r"^([*\w]+(?:, [*\w]+)*)(?: : .*)?\n(?= )", "\n".join(map(inspect.cleandoc, docs)), re.MULTILINE
    )
    names = [name.strip(" *") for entry in entries for name in entry.split(",")]
    return {*names, *re.findall(r"``(\w+)``", " ".join(docs))}


def test_every_error_that_is_raised_is_described():
    silent = [
        f"{name}{'.' if member else ''}{member}"
        for name, thing in public()
        for member, part in [("", thing), *methods(thing)]
        if raises(part) and "Raises\n" not in f"{part.__doc__}{thing.__doc__ if member else ''}"
    ]
    assert not silent


def raises(part: Any) -> bool:
    """Return whether a function, a property or a constructor raises by itself, not only through calls."""
    part = vars(part).get("__init__") if inspect.isclass(part) else part
    part = getattr(part, "fget", None) or getattr(part, "__func__", part)
    if not inspect.isfunction(part) or not (source := source_of(part)):
        return False
    return any(isinstance(node, ast.Raise) for node in ast.walk(ast.parse(source)))


def source_of(function: Any) -> str:
    """Return a function's source; the methods that a dataclass generates have none."""
    try:
        return textwrap.dedent(inspect.getsource(function))
    except OSError:
        return ""


def methods(thing: Any) -> list[tuple[str, Any]]:
    """Return the public methods and properties that a class itself defines."""
    own = vars(thing).items() if inspect.isclass(thing) else ()
    kinds = (property, classmethod, staticmethod)
    return [(n, p) for n, p in own if n[0] != "_" and (inspect.isfunction(p) or isinstance(p, kinds))]


@pytest.mark.long
def test_the_documentation_builds_without_a_warning(tmp_path):
    sphinx = pytest.importorskip("sphinx.cmd.build", reason="Sphinx is not installed: pip install '.[docs]'")
    for package in ("myst_nb", "furo", "sphinx_copybutton"):
        pytest.importorskip(package)
    shutil.rmtree(
        ROOT / "docs" / "generated", ignore_errors=True
    )  # it may describe names that no longer exist
    where = [str(ROOT / "docs"), str(tmp_path / "html")]
    assert sphinx.build_main(["-q", "-W", "--keep-going", "-b", "html", *where]) == 0
    assert (tmp_path / "html" / "index.html").is_file()
