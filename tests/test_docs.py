"""The documents tell the truth: their links lead somewhere, their commands and programs are possible, and the site builds without
a warning."""

import ast
import contextlib
import importlib
import importlib.util
import inspect
import json
import re
import runpy
import shlex
import subprocess
import sys
import textwrap
import tomllib
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

import penumbra
from penumbra.services.command import cli
from penumbra.tests.bench.lib import published

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 150


def test_the_readme_s_accuracy_is_that_of_the_results():
    readme = (ROOT / "README.md").read_text()
    table, fusion, haptics = (
        json.loads((published.DATA / f"{name}.json").read_text()) for name in ("table1", "fusion", "haptics")
    )
    multimodal = table["columns"].index("multimodal_procnet")

    def of_run(reach: str, hidden: str) -> str:
        return f"{table[f'haptic_range_{reach}']['short_0_3m'][hidden]['ours'][multimodal]:.2f} cm"

    def by_direction(values: dict[str, float]) -> str:
        return " / ".join(f"{values[name]:.1f}" for name in ("lateral", "height", "axial")) + " mm"

    visible = fusion["situations"]["visible"]
    skin = {"array": "bare", "gap_m": 0.05, "pads": 8, "prior": True, "speed": 0.0}
    (felt,) = (row for row in haptics["rows"] if skin.items() <= row.items())
    for row in (
        f"skin in range, mean error | {of_run('inside', 'light')} |",
        f"the same, heavily occluded | {of_run('inside', 'heavy')} |",
        f"heavily occluded, skin out of range | {of_run('outside', 'heavy')} |",
        f"visible, mean error | {visible['error_cm']:.2f} cm | gtsam's smoother {visible['baselines_cm']['gtsam']:.2f} cm |",
        f"| {by_direction(felt['rmse_mm'])} | Cramér-Rao bound {by_direction(felt['bound_mm'])} |",
    ):
        assert row in readme


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_link_leads_to_a_file(page):
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    links = re.findall(r"\]\(([^)#\s]+)[^)]*\)", text)
    missing = [link for link in links if "://" not in link and not (page.parent / link).exists()]
    assert not missing


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path)]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    assert {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("index.html")} >= {
        "index.html",
        "install/index.html",
    }


def test_every_page_is_in_the_menu_of_the_site():
    menu = (ROOT / "mkdocs.yml").read_text()
    pages = {page.relative_to(ROOT / "docs").as_posix() for page in (ROOT / "docs").rglob("*.md")}
    assert not {page for page in pages if f"- {page}\n" not in menu}


def test_every_name_of_the_client_is_on_its_page_of_the_api():
    shown = re.findall(r"^::: penumbra\.(\w+)$", (ROOT / "docs" / "api.md").read_text(), re.MULTILINE)
    assert sorted(shown) == sorted(penumbra.__all__)


def test_the_page_of_messages_is_that_of_the_tables():
    written = runpy.run_path(str(ROOT / "docs" / "messages.py"))
    assert (ROOT / "docs" / "messages.md").read_text() == written["page"](), "run `just docs`"


@pytest.mark.parametrize("page", sorted(published.PAGES.glob("*.md")), ids=lambda page: page.name)
def test_the_tables_of_the_results_are_what_their_files_give(page):
    text = page.read_text()
    assert published.filled(text) == text, "run `just results`"


def test_every_result_has_its_page():
    assert not published.unshown()


@pytest.mark.parametrize("page", sorted(published.PAGES.glob("*.md")), ids=lambda page: page.name)
def test_a_table_that_was_copied_by_hand_says_when_it_was_measured(page):
    by_hand = {
        name: text for name, text in published.regions(page.read_text()).items() if not (published.DATA / f"{name}.json").exists()
    }
    assert not [name for name, text in by_hand.items() if not published.BY_HAND.match(text)]


# ---- commands


def blocks(page: Path, language: str) -> list[str]:
    found = re.findall(rf"^ *```{language}\n(.*?)^ *```", page.read_text(), re.DOTALL | re.MULTILINE)
    return [textwrap.dedent(block) for block in found]


def shown(page: Path) -> Iterator[tuple[str, bool]]:
    """The command lines of a page, and whether each is whole: those of its shell blocks are, those that running text mentions may
    leave out what the command cannot do without."""
    for block in blocks(page, "sh"):
        yield from ((line, True) for line in block.replace("\\\n", " ").splitlines())
    prose = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    yield from ((line, False) for line in mentioned(prose))


def mentioned(text: str) -> list[str]:
    """The commands that a text mentions."""
    return [" ".join(code.split()) for code in re.findall(r"`(penumbra\s[^`]+)`", text)]


def commands(line: str) -> Iterator[list[str]]:
    """The commands of a command line, each as its words."""
    parts = shlex.shlex(line, posix=True, punctuation_chars=True)
    parts.whitespace_split = True
    words: list[str] = []
    last = ""
    for word in [*parts, ";"]:
        if set(word) <= set("();|&"):
            if words:
                yield words
            words = []
        elif not set(word + last) & set("<>"):  # nor the file of > and <
            words.append(word)
        last = word


def parse(argv: list[str]) -> None:
    """Reads the words that follow `penumbra` without running anything. Raises click.ClickException for what there is not."""
    command: click.Command = cli.PENUMBRA
    parent, words = None, argv
    with contextlib.suppress(click.exceptions.Exit):  # --help
        while True:
            context = command.make_context("penumbra", list(words), parent=parent)
            words = [*context._protected_args, *context.args]  # click keeps the first word that follows a group for itself
            if not isinstance(command, click.Group) or not words:
                return
            _, found, words = command.resolve_command(context, words)
            assert found is not None
            command, parent = found, context


def fault(words: list[str], is_whole: bool) -> str | None:
    """Why a command cannot be given; None where it can, or is not of this project."""
    if "--" in words and words[0] in ("kubectl", "docker"):
        words = words[words.index("--") + 1 :]
    match words:
        case ["penumbra", *argv] if any(word.strip(".").isupper() for word in argv[:1]) or {"NAME", "ARGV..."} & set(argv):
            return None  # stands for any
        case ["penumbra", *argv]:
            try:
                parse(argv)
            except click.ClickException as error:
                lacks_something = isinstance(error, click.MissingParameter) or "requires an argument" in error.message
                return None if lacks_something and not is_whole else error.format_message()
        case ["just", recipe, *_]:
            recipes = re.findall(r"^([\w-]+)[^:\n]*:(?!=)", (ROOT / "justfile").read_text(), re.MULTILINE)
            return None if recipe in recipes else f"no recipe {recipe}"
        case ["python", "-m", module, *_] if module.startswith("penumbra"):
            return None if importlib.util.find_spec(module) else f"no module {module}"
        case ["python", script, *_] if script.endswith(".py"):
            return None if (ROOT / script).is_file() else f"no file {script}"
        case ["pip", "install", *packages]:
            extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
            unknown = {extra for package in packages for extra in re.findall(r"[\w-]+", package.partition("[")[2])} - set(extras)
            return f"no extra {', '.join(unknown)}" if unknown else None
    return None


NOW = [page for page in PAGES if page.name != "CHANGELOG.md"]
"""Pages that say what is there now, and not what was."""


@pytest.mark.parametrize("page", NOW, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_command_on_a_page_can_be_given(page, tmp_path, monkeypatch):
    (tmp_path / "docs").symlink_to(ROOT / "docs")
    monkeypatch.chdir(tmp_path)  # as some flags make their folder
    added = {f"penumbra {name}" for name in re.findall(r'^ *NAME = "(\w+)"', page.read_text(), re.MULTILINE)}  # by the page
    wrong = {
        shlex.join(words): found
        for line, is_whole in shown(page)
        for words in commands(line)
        if (found := fault(words, is_whole)) and " ".join(words[:2]) not in added
    }
    assert not wrong


def texts(path: Path) -> Iterator[str]:
    """The texts in a file of Python: messages, help and docstrings, with X for what is inserted."""
    inside: set[int] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        match node:
            case ast.JoinedStr(values=parts):
                inside |= {id(part) for part in parts}
                yield "".join(str(part.value) if isinstance(part, ast.Constant) else "X" for part in parts)
            case ast.Constant(value=str(text)) if id(node) not in inside:
                yield text


def test_every_command_of_compose_with_a_profile_names_a_router():
    text = "".join(path.read_text() for path in (*PAGES, ROOT / "compose.yaml"))
    commands = re.findall(r"docker compose [^\n`#]*--profile [^\n`#]*", text)
    assert len(commands) >= 4
    assert not [each for each in commands if not re.search("--profile (router|zenohd)", each)], "a profile replaces that of .env"


def test_every_command_that_a_message_or_a_docstring_mentions_can_be_given(capsys):
    files = [
        path for floor in ("services", "sim", "shared", "penumbra/client", "examples") for path in (ROOT / floor).rglob("*.py")
    ]
    wrong = {
        f"{path.relative_to(ROOT)}: {line}": found
        for path in files
        for text in texts(path)
        for line in mentioned(text)
        for words in commands(line)
        if (found := fault(words, False))
    }
    assert not wrong


@pytest.mark.parametrize(
    "line",
    [
        "penumbra upp --cell table",
        "penumbra up --cells table",
        "cd x && penumbra up --vision nonsense",
        "penumbra haptics tran",
        "penumbra bench lives",
        "penumbra pose > pose.txt --vision posecnn",
        "penumbra check",
        "kubectl exec deploy/fusion -- penumbra poze",
        "pip install -e '.[every,test]' && pytest",
        "just tset",
    ],
)
def test_a_command_that_there_is_not_is_found(line):
    assert any(fault(words, True) for words in commands(line))


# ---- programs


def uses(code: str) -> Iterator[tuple[str, set[str]]]:
    """What a program takes of `penumbra`: dotted names, each with the names of the arguments of its call."""
    tree = ast.parse(code)
    calls = {
        id(node.func): {word.arg for word in node.keywords if word.arg} for node in ast.walk(tree) if isinstance(node, ast.Call)
    }
    for node in ast.walk(tree):
        match node:
            case ast.Import(names=names):
                yield from ((each.name, set()) for each in names if each.name.partition(".")[0] == "penumbra")
            case ast.ImportFrom(module=str(module), names=names) if module.partition(".")[0] == "penumbra":
                yield from ((f"{module}.{each.name}", set()) for each in names)
            case ast.Attribute(value=ast.Name(id="penumbra"), attr=name):
                yield f"penumbra.{name}", calls.get(id(node), set())


def find(name: str) -> object:
    """What a dotted name of `penumbra` stands for. Raises AttributeError or ImportError where there is no such thing."""
    module, _, last = name.rpartition(".")
    if not module:
        return importlib.import_module(name)
    owner = importlib.import_module(module)
    return getattr(owner, last) if hasattr(owner, last) else importlib.import_module(name)


def programs() -> Iterator[tuple[str, str]]:
    """The programs of all pages and of the package's docstring, each with its page."""
    for page in PAGES:
        for code in blocks(page, "python"):
            yield page.relative_to(ROOT).as_posix(), code
    yield "penumbra/__init__.py", textwrap.dedent("\n".join(re.findall(r"^    .*$", penumbra.__doc__ or "", re.MULTILINE)))


def wrong_uses(code: str) -> list[str]:
    """What a program takes of `penumbra` that is not there."""
    wrong = []
    for name, arguments in uses(code):
        try:
            found = find(name)
        except (AttributeError, ImportError) as error:
            wrong.append(str(error))
            continue
        unknown = arguments - set(inspect.signature(found).parameters) if callable(found) else set()
        wrong += [f"{name} takes no {argument}" for argument in sorted(unknown)]
    return wrong


def test_what_programs_on_pages_use_of_the_package_is_there():
    count = 0
    for page, code in programs():
        compile(code, page, "exec", flags=ast.PyCF_ALLOW_TOP_LEVEL_AWAIT)
        assert not wrong_uses(code), page
        count += len(list(uses(code)))
    assert count > 5


@pytest.mark.parametrize(
    "code",
    [
        "import penumbra\npenumbra.conect()",
        "import penumbra\npenumbra.connect(endpoints='tcp/robot:7447')",
        "from penumbra.client.pose import Posture",
        "import penumbra.clients",
    ],
)
def test_what_the_package_does_not_have_is_found(code):
    assert len(wrong_uses(code)) == 1
