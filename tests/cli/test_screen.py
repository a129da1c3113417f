"""A browser is opened without a token in the list of processes."""

import json
import os
import re
import signal
import stat
import subprocess
import sys
from pathlib import Path

import gsplat_edu
from waiting import PATIENCE, until

BROWSER = """#!{python}
import html, json, os, re, sys, urllib.request
path = sys.argv[1].removeprefix("file://")
text = open(path).read()
url = html.unescape(re.search('url=([^"]*)', text)[1])
request = urllib.request.Request(url, headers={{"Sec-Fetch-Site": "cross-site"}})  # as from a file
answer = urllib.request.urlopen(request)
found = {{"argv": sys.argv, "url": url, "status": answer.status, "cookie": answer.headers["Set-Cookie"]}}
found |= {{"file": os.stat(path).st_mode, "folder": os.stat(os.path.dirname(path)).st_mode}}
with open({out!r} + ".part", "w") as file:
    json.dump(found, file)
os.rename({out!r} + ".part", {out!r})
"""


def test_the_browser_of_a_studio_gets_a_private_file_that_leads_to_the_page(tmp_path):
    browser, out, private = tmp_path / "browser", tmp_path / "found.json", tmp_path / "private"
    browser.write_text(BROWSER.format(python=sys.executable, out=str(out)))
    browser.chmod(0o755)
    private.mkdir()
    command = [sys.executable, "-m", "gsplat_edu", "studio", str(tmp_path / "library"), "--port", "0"]
    env = {**os.environ, "BROWSER": f"{browser} %s", "DISPLAY": ":99", "TMPDIR": str(private)}
    near, far = os.openpty()  # a browser is opened for people only
    process = subprocess.Popen(command, stdin=far, stdout=far, env=env)
    os.close(far)
    try:
        printed = b""
        while b"token=" not in printed or b"\n" not in printed.partition(b"token=")[2]:
            printed += os.read(near, 65536)
        (token,) = re.findall(r"token=(\S+)", printed.decode())
        until(out.is_file)
        found = json.loads(out.read_text())
        assert found["argv"][1:] == [str(next(private.rglob("*.html")).as_uri())]
        assert not any(token in word for word in found["argv"])
        assert found["url"].endswith(f"/?token={token}")
        assert found["status"] == 200 and token in found["cookie"]
        assert stat.S_IMODE(found["file"]) == 0o600 and stat.S_IMODE(found["folder"]) == 0o700
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(PATIENCE)
        os.close(near)
    assert list(private.iterdir()) == []


def test_no_other_place_opens_a_browser():
    root = Path(gsplat_edu.__file__).parent
    users = [path.relative_to(root) for path in root.rglob("*.py") if "webbrowser" in path.read_text("utf-8")]
    assert users == [Path("cli", "screen.py")]
