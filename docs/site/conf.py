"""Sphinx settings of the site; `course/build_site.py` gathers the pages and runs it."""

import re

from docutils.nodes import SkipNode
from latex2mathml.converter import convert

project = "gsplat_edu"
copyright = "the authors of gsplat_edu"  # noqa: A001
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]

html_theme = "furo"
html_title = "gsplat_edu"
html_copy_source = False
html_show_sphinx = False
html_math_renderer = "mathml"
html_static_path = ["static"]
html_css_files = ["tokens.css", "site.css"]  # the first one comes from course/build_site.py

# What a notebook shows was made by course/build_notebooks.py.
nb_execution_mode = "off"
nb_code_prompt_show = "Show the set-up code"
nb_code_prompt_hide = "Hide the set-up code"
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4

default_role = "py:obj"
highlight_language = "text"  # equations of docstrings; notebooks and documents say what theirs is
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False

CODE = re.compile(r"`[^`]*`")
SECTION = re.compile(r"\s*(Args|Attributes|Returns|Yields|Raises):")
of_variables = {}
CHAPTERS = re.compile(r"Chapters?: (.*)\.")


def escaped(line):
    """Take their meaning from characters that reStructuredText reads and our docstrings mean as they stand."""

    def outside(text):
        return re.sub(r"([\\*|_])", r"\\\1", text)

    codes = [*CODE.findall(line), ""]
    return "".join(outside(text) + code for text, code in zip(CODE.split(line), codes, strict=True))


def docstrings(app, what, name, thing, options, lines):
    """Turn a docstring as we write them into one that napoleon reads: equations and drawings keep their lines."""
    found, in_section = [], False
    for paragraph in "\n".join(lines).split("\n\n"):
        rows = paragraph.strip("\n").split("\n")
        if rows[0].strip() in ("Returns:", "Yields:") and len(rows) > 1:
            # napoleon would take what stands before a colon for a type, but not before one that stands first
            indent = len(rows[1]) - len(rows[1].lstrip())
            rows[1] = rows[1][:indent] + ": " + rows[1][indent:]
        in_section = in_section or SECTION.match(rows[0]) is not None
        equation = " = " in paragraph and not rows[-1].rstrip().endswith((".", ":"))
        drawing = all(row.startswith("    ") for row in rows)
        if named := CHAPTERS.fullmatch(rows[-1]):
            links = ", ".join(f":doc:`/notebooks/{chapter}`" for chapter in named[1].split(", "))
            found += [*map(escaped, rows[:-1]), "", f"Explained in {links}.", ""]
        elif not in_section and (equation or drawing):
            found += ["::", "", *("    " + row for row in rows), ""]
        else:
            found += [*map(escaped, rows), ""]
    lines[:] = found
    if what in ("data", "attribute", "property"):
        of_variables[name], lines[:] = found, []


def variables(app, what, name, thing, options, lines):
    """Put a variable's docstring back: napoleon would have taken what stands before a colon for its type."""
    lines[:] = of_variables.pop(name, lines)


def setup(app):
    """Draw equations as MathML, which browsers show without a script or a font from elsewhere."""

    def inline(writer, node):
        writer.body.append(convert(node.astext()))
        raise SkipNode

    def display(writer, node):
        writer.body.append(f'<div class="math">{convert(node.astext(), display="block")}</div>')
        raise SkipNode

    app.add_html_math_renderer("mathml", (inline, None), (display, None))
    app.connect("autodoc-process-docstring", docstrings, priority=100)
    app.connect("autodoc-process-docstring", variables, priority=900)
