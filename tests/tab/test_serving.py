"""The server of the page, and its command."""

import re
import shutil
import urllib.error
import urllib.request

import pytest

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.tab.serving import (
    EXAMPLE,
    MODULES,
    PACKAGE,
    PAGE,
    POLICY,
    ROOMS,
    TabServer,
    page_files,
    write_page,
)


@pytest.fixture(scope="module")
def server(node):  # node's fixture checks that the module is built
    with TabServer() as made:
        made.start(made.application())
        yield made


def get(server, path):
    with urllib.request.urlopen(server.url.rstrip("/") + path) as answer:
        return answer.headers, answer.read()


TYPES = {
    "/": "text/html; charset=utf-8",
    "/tab/web/worker.js": "text/javascript; charset=utf-8",
    "/tab/web/style.css": "text/css; charset=utf-8",
    **{f"/tab/web/{name}": "application/wasm" for name in MODULES},
    "/base/web/icons.svg": "image/svg+xml",
    EXAMPLE: "application/octet-stream",
}


@pytest.mark.parametrize("path", TYPES)
def test_answers_isolate_the_page_and_forbid_other_servers(server, path):
    headers, body = get(server, path)
    assert headers["Content-Type"] == TYPES[path] and body
    assert headers.get_all("Cross-Origin-Opener-Policy") == ["same-origin"]
    assert headers.get_all("Cross-Origin-Embedder-Policy") == ["require-corp"]
    assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
    rules = dict(rule.split(" ", 1) for rule in headers["Content-Security-Policy"].split("; "))
    assert rules["default-src"] == "'none'" and rules["connect-src"] == "'self'"
    assert not {source for sources in rules.values() for source in sources.split()} - {
        *("'none'", "'self'", "'wasm-unsafe-eval'", "data:", "blob:")
    }


@pytest.mark.parametrize(
    "path", ["/tab/serving.py", "/tab/web/../serving.py", "/studio/web/app.js", "/tab/web/"]
)
def test_other_files_are_not_served(server, path):
    with pytest.raises(urllib.error.HTTPError, match="404"):
        get(server, path)


def test_the_page_names_the_shared_modules_at_once():
    """Otherwise a browser finds each of them only after loading the one that imports it."""
    page = (PACKAGE / "tab/web/index.html").read_text("utf-8")
    imported = (PACKAGE / "tab/web/page.js").read_text("utf-8")
    shared = {
        line.split("../../")[1].rstrip('";') for line in imported.splitlines() if 'from "../../' in line
    }
    assert len(shared) == 3 and all(f'<link rel="modulepreload" href="{name}">' in page for name in shared)


@pytest.mark.parametrize("missing", MODULES)
def test_without_a_module_one_line_says_how_to_build_it(node, tmp_path, missing):
    for room in ROOMS:
        shutil.copytree(
            PACKAGE / room / "web", tmp_path / room / "web", ignore=shutil.ignore_patterns(missing)
        )
    with pytest.raises(ArgumentError, match=f"{missing}: is not built; run python tools/build_wasm.py"):
        page_files(tmp_path)


def test_the_page_is_written_for_any_folder_of_a_server(node, tmp_path):
    """Its links begin at the page, wherever that is; the policy stands in the page."""
    write_page(tmp_path)
    written = {f"/{path.relative_to(tmp_path).as_posix()}" for path in tmp_path.rglob("*") if path.is_file()}
    assert written == page_files().keys() - {PAGE} | {"/index.html"}
    assert f'content="{POLICY}"' in (tmp_path / "index.html").read_text("utf-8")
    texts = [path.read_text("utf-8") for path in (tmp_path / "tab").rglob("*.js")]
    texts.append((tmp_path / "index.html").read_text("utf-8"))
    assert not [text for text in texts if re.search(r"[\"'`]/(base|tab|viewer|example)", text)]
