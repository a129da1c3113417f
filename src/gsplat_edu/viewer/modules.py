"""Put the modules of a page's script together as one classic script, which works in a file opened from disk.

The scripts in `viewer/web` are ES modules: they say by `import` what they use and by `export` what others use. A
browser loads no module from a file on disk, so a page contains one script with the text of all modules that its entry
modules reach, without their imports and the word `export`.

Modules run in the order in which a JavaScript engine runs them: depth first, each after those that it imports, in the
order of its imports. Where modules import each other in a cycle, the one that is reached first runs last; inside
functions they may use each other's names, at once they may not.

They share one scope, so no two of them may define the same name. An import has the form
`import { a, b } from "./x.js";`, and an export stands before a declaration.
"""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass
from importlib.resources import files

IMPORT = re.compile(r'^import (?:\{([\w\s,$]*)\} from )?"\./([\w.]+)";\n', re.MULTILINE)

MODULE_SYNTAX = re.compile(
    r"^(?:import\b|export (?!const |let |function|async function|class )).*", re.MULTILINE
)
"""A line of an import, or of an export without a declaration."""

DEFINITION = re.compile(
    r"^(export )?(?:async )?(?:function\*?|class|const|let|var) (\w+|\[[^\]]*\]|\{[^}]*\})", re.MULTILINE
)
"""A declaration in the scope of a module: one name, or the names of a pattern."""


@dataclass(frozen=True)
class Module:
    """One module of a page.

    Args:
        imports: The names that it uses of other modules, by file, in the order of the import lines.
        exports: The names that others may use.
        names: All names that it defines in its scope.
        text: Its text without import lines and the word `export`.
    """

    imports: dict[str, tuple[str, ...]]
    exports: frozenset[str]
    names: tuple[str, ...]
    text: str


def web(name: str) -> str:
    """Return the text of a file in `viewer/web`."""
    return (files("gsplat_edu.viewer") / "web" / name).read_text("utf-8")


@functools.cache
def script(entries: tuple[str, ...]) -> str:
    """Return one classic script of the modules that these files import, and of these.

    Args:
        entries: Names of files in `viewer/web`, in the order in which they run.

    Raises:
        ValueError: A module imports what is not exported, two modules define one name, or a line has another form.
    """
    modules: dict[str, Module] = {}
    order: list[str] = []

    def visit(name: str) -> None:
        if name in modules:
            return
        modules[name] = module = parsed(name, web(name))
        for imported in module.imports:
            visit(imported)
        order.append(name)

    for entry in entries:
        visit(entry)
    check(modules)
    return "\n".join(['"use strict";', *(modules[name].text for name in order)])


def check(modules: dict[str, Module]) -> None:
    """Check that every imported name is exported, and that no name is defined twice.

    Args:
        modules: The modules of a page by file; contains those that they import.

    Raises:
        ValueError: With one line that names the modules.
    """
    owners: dict[str, str] = {}
    for name, module in modules.items():
        for imported, words in module.imports.items():
            for word in words:
                if word not in modules[imported].exports:
                    raise ValueError(
                        f"{name}: {imported} does not export {word}; export it, or import it from elsewhere"
                    )
        for word in module.names:
            if word in owners:
                raise ValueError(
                    f"{name}: {owners[word]}, on the same page, defines {word} too; rename one of them"
                )
            owners[word] = name


def parsed(name: str, source: str) -> Module:
    """Read the imports and exports of a module.

    Args:
        name: Its file, for messages.
        source: Its text.

    Raises:
        ValueError: An import or export has a form that a page's script cannot have.
    """
    imports: dict[str, tuple[str, ...]] = {}
    for words, imported in IMPORT.findall(source):
        imports[imported] = imports.get(imported, ()) + tuple(re.findall(r"[\w$]+", words))
    text = IMPORT.sub("", source)
    if other := MODULE_SYNTAX.search(text):
        raise ValueError(
            f'{name}: "{other[0]}" has another form than imports and exports of these modules; see modules.py'
        )
    exports: set[str] = set()
    names: list[str] = []
    for exported, pattern in DEFINITION.findall(text):
        words = re.findall(r"\w+", pattern)
        names += words
        exports.update(words if exported else ())
    return Module(
        imports, frozenset(exports), tuple(names), re.sub(r"^export ", "", text, flags=re.MULTILINE)
    )
