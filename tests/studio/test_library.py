"""Entries with all kinds of names are listed, adopted, renamed, removed and restored."""

import json
import re
import shutil
import threading
from importlib.resources import files

import pytest

from gsplat_edu.server.refusal import RefusedError
from gsplat_edu.studio import contents as contents_module
from gsplat_edu.studio.library import scene_file
from gsplat_edu.studio.projects import newest_export
from photos import blank_png
from studio.conftest import picture

NAMES = ["toy", "Hütte im Schnee", "写真", "<img src=x onerror=alert(1)>", "a'b`c$(d)", "ا"]  # noqa: RUF001

REFUSED = [
    "",
    " ",
    "..",
    ".hidden",
    "-rf",
    "a/b",
    "a\\b",
    "a\nb",
    "a\x00b",
    "a\u202eb",
    "end.",
    "end ",
    "x" * 121,
    "C:",
    "a?",
]


def entry(studio, kind, name, **files):
    folder = studio.library.root / kind / name
    folder.mkdir()
    for file, data in files.items():
        (folder / file.replace("__", ".")).write_bytes(data)
    return folder


def listed(page, kind):
    return [found["name"] for found in page.get("/api/library").json()[kind]]


@pytest.mark.parametrize("name", NAMES)
def test_names_of_any_script_are_kept(page, studio, name, jpeg):
    answer = page.put(f"/api/photos/{quoted(name)}/files/{quoted(name)}.jpg", content=jpeg)
    assert answer.status_code == 201, answer.text
    assert listed(page, "photos") == [name]
    photos = page.get(f"/api/photos/{quoted(name)}/photos").json()["photos"]
    assert [(photo["name"], photo["W"], photo["H"]) for photo in photos] == [(f"{name}.jpg", 24, 18)]


def quoted(name):
    from urllib.parse import quote

    return quote(name, safe="")


@pytest.mark.parametrize("name", REFUSED, ids=ascii)
def test_other_names_are_refused_in_one_line(page, studio, tmp_path, name):
    entry(studio, "photos", "there")
    answer = page.post("/api/photos/there/rename", json={"to": name})
    assert answer.status_code == 400 and answer.json()["error"].count("\n") == 0
    (tmp_path / "outside").mkdir()
    answer = page.post("/api/adopt", json={"kind": "photos", "path": str(tmp_path / "outside"), "name": name})
    assert answer.status_code == 400
    assert listed(page, "photos") == ["there"]


def test_two_spellings_of_a_letter_are_one_name(page, studio, jpeg):
    assert page.put("/api/photos/e\u0301/files/a.jpg", content=jpeg).status_code == 201
    assert listed(page, "photos") == ["\u00e9"]
    assert page.put("/api/photos/\u00e9/files/a.jpg", content=jpeg).status_code == 409


def test_a_folder_elsewhere_is_adopted_and_only_its_link_removed(page, studio, tmp_path, jpeg):
    outside = tmp_path / "photos of a trip"
    (outside / "day 1").mkdir(parents=True)
    (outside / "day 1" / "a.jpg").write_bytes(jpeg)
    found = page.post("/api/adopt", json={"kind": "photos", "path": str(outside), "name": "trip"}).json()
    assert found["adopted"] == str(outside) and found["photos"] == 1
    assert page.get("/api/photos/trip/thumbs/day 1/a.jpg").status_code == 200
    assert page.put("/api/photos/trip/files/b.jpg", content=jpeg).status_code == 409
    number = page.delete("/api/photos/trip").json()["trash"]
    assert page.post(f"/api/trash/{number}/restore").status_code == 200 and listed(page, "photos") == ["trip"]
    page.delete("/api/photos/trip")
    assert page.delete("/api/trash").json() == {"trash": []}
    assert (outside / "day 1" / "a.jpg").is_file() and listed(page, "photos") == []


def test_places_that_cannot_be_adopted_are_refused(page, studio, tmp_path):
    (tmp_path / "notes.txt").touch()
    for path in (
        "relative",
        "/nowhere",
        str(studio.library.root),
        str(tmp_path),
        str(tmp_path / "notes.txt"),
    ):
        answer = page.post("/api/adopt", json={"kind": "photos", "path": path, "name": "x"})
        assert answer.status_code == 400, path
    (tmp_path / "holiday.mp4").touch()
    found = page.post(
        "/api/adopt", json={"kind": "photos", "path": str(tmp_path / "holiday.mp4"), "name": "x"}
    )
    assert found.json()["videos"] == 1
    assert (
        page.post(
            "/api/adopt", json={"kind": "photos", "path": str(tmp_path / "holiday.mp4"), "name": "x"}
        ).status_code
        == 409
    )


def test_a_removed_export_comes_back_from_the_trash(page, studio):
    """Under whatever name its run has by then, and never over another file."""
    exports = entry(studio, "runs", "a") / "exports"
    exports.mkdir()
    (exports / "a.mesh.glb").write_bytes(b"eight minutes")
    number = page.delete("/api/runs/a/exports/a.mesh.glb").json()["trash"]
    assert page.get("/api/runs/a/exports").json() == {"exports": []}
    (removed,) = page.get("/api/trash").json()["trash"]
    assert (removed["kind"], removed["name"], removed["entry"]) == ("exports", "a.mesh.glb", "runs/a")
    assert page.post("/api/runs/a/rename", json={"to": "b"}).status_code == 200
    exports = exports.parent.with_name("b") / "exports"
    (exports / "a.mesh.glb").write_bytes(b"newer")
    assert page.post(f"/api/trash/{number}/restore").status_code == 409
    shutil.rmtree(exports)
    run = page.delete("/api/runs/b").json()["trash"]
    answer = page.post(f"/api/trash/{number}/restore")
    assert answer.status_code == 409 and "runs/b: does not exist; restore it first" in answer.json()["error"]
    assert page.post(f"/api/trash/{run}/restore").status_code == 200
    assert page.post(f"/api/trash/{number}/restore").json()["entry"] == "runs/b"
    assert (exports / "a.mesh.glb").read_bytes() == b"eight minutes"
    assert page.get("/api/trash").json() == {"trash": []}


@pytest.mark.parametrize(
    "source", ["runs/../exports", "runs/a/live", "runs/a/exports/b", ".studio/a/exports", "a"]
)
def test_a_trash_from_elsewhere_restores_nothing_outside_of_exports(page, studio, source):
    entry(studio, "runs", "a")
    folder = studio.library.hidden("trash") / f"{7:020d}"
    folder.mkdir()
    (folder / "from.txt").write_text(source)
    (folder / "pause").touch()
    assert page.post(f"/api/trash/{folder.name}/restore").status_code in (400, 404)
    assert (folder / "pause").exists()


def test_rename_remove_and_restore(page, studio, jpeg):
    entry(studio, "captures", "a", photo__jpg=jpeg)
    entry(studio, "captures", "b")
    assert page.post("/api/captures/a/rename", json={"to": "b"}).status_code == 409
    assert page.post("/api/captures/a/rename", json={"to": "c"}).json()["entry"] == "captures/c"
    assert page.get("/api/captures/a").status_code == 404
    first = page.delete("/api/captures/c").json()["trash"]
    entry(studio, "captures", "c")
    assert page.post(f"/api/trash/{first}/restore").status_code == 409  # another entry has its name now
    shutil.rmtree(studio.library.root / "captures" / "c")
    assert page.post(f"/api/trash/{first}/restore").json()["photos"] == 1
    assert page.post(f"/api/trash/{first}/restore").status_code == 404


def test_entries_that_a_job_uses_cannot_be_moved(page, studio):
    entry(studio, "captures", "a")
    entry(studio, "captures", "ab")
    job = page.post("/api/jobs", json={"command": "train", "subject": "captures/a", "to": "r"}).json()
    assert page.post("/api/captures/a/rename", json={"to": "x"}).status_code == 409
    assert page.delete("/api/captures/a").status_code == 409
    assert page.post("/api/captures/ab/rename", json={"to": "x"}).status_code == 200
    page.post(f"/api/jobs/{job['id']}/cancel")
    assert page.delete("/api/captures/a").status_code == 200


@pytest.mark.parametrize(
    "path",
    [
        "../a.jpg",
        "%2e%2e/a.jpg",
        "..%2f..%2fsecret.jpg",
        "%2fetc%2fpasswd",
        "x/../../secret.jpg",
        ".hidden.jpg",
        "%00.jpg",
    ],
)
def test_no_path_leads_out_of_an_entry(page, studio, jpeg, path):
    entry(studio, "photos", "a")
    (studio.library.root / "secret.jpg").write_bytes(jpeg)
    for answer in (
        page.get(f"/api/photos/a/thumbs/{path}"),
        page.put(f"/api/photos/a/files/{path}", content=jpeg),
        page.get(f"/api/scenes/{path}/scene"),
        page.get(f"/api/scenes/a/exports/{path}"),
    ):
        assert answer.status_code in (400, 404, 405), answer.text
    assert sorted(p.name for p in studio.library.root.iterdir()) == [
        ".studio", "captures", "photos", "runs", "scenes", "secret.jpg",
    ]  # fmt: skip


def test_links_inside_an_entry_are_not_followed(page, studio, tmp_path, jpeg):
    (tmp_path / "secret.jpg").write_bytes(jpeg)
    (entry(studio, "photos", "a") / "link.jpg").symlink_to(tmp_path / "secret.jpg")
    assert page.get("/api/photos/a/thumbs/link.jpg").status_code == 400


def test_thumbnails_are_upright_small_and_cached(page, studio):
    from PIL import Image

    exif = Image.Exif()
    exif[0x0112] = 6  # a portrait
    entry(studio, "photos", "a", a__jpg=picture("JPEG", (400, 200), exif=exif), broken__jpg=b"no photo")
    photos = {photo["name"]: photo for photo in page.get("/api/photos/a/photos").json()["photos"]}
    assert (photos["a.jpg"]["W"], photos["a.jpg"]["H"]) == (200, 400)
    assert photos["broken.jpg"]["problem"] and photos["broken.jpg"]["W"] is None
    answer = page.get("/api/photos/a/thumbs/a.jpg?side=128")
    import io

    with Image.open(io.BytesIO(answer.content)) as image:
        assert image.size == (64, 128) and image.format == "JPEG"
    assert answer.headers["content-type"] == "image/jpeg"
    again = page.get("/api/photos/a/thumbs/a.jpg?side=128", headers={"If-None-Match": answer.headers["etag"]})
    assert again.status_code == 304
    assert page.get("/api/photos/a/thumbs/broken.jpg").status_code == 422
    assert page.get("/api/photos/a/thumbs/a.jpg?side=100000").status_code == 400


def test_photos_are_decoded_by_another_process_within_limits(page, studio):
    """No uploaded photo is ever decoded in the server's process."""
    entry(studio, "photos", "a", a__jpg=picture("JPEG", (400, 200)), b__png=blank_png(17_290, 17_290))
    answer = page.get("/api/photos/a/thumbs/b.png")
    assert answer.status_code == 422 and "is too much for a photo" in answer.json()["error"]
    assert page.get("/api/photos/a/thumbs/a.jpg").status_code == 200
    studio.decoder.close()
    assert page.get("/api/photos/a/thumbs/a.jpg").status_code == 200, "the thumbnail is cached"
    assert page.get("/api/photos/a/thumbs/a.jpg?side=128").status_code == 500, "the server does not decode it"


def test_fifty_clients_get_the_same_list(page, studio, jpeg):
    entry(studio, "photos", "a", a__jpg=jpeg)
    answers = []
    threads = [
        threading.Thread(target=lambda: answers.append(page.get("/api/library").json())) for _ in range(50)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for answer in answers:
        del answer["free_bytes"]  # free space of the disk, which other programs use, too
    assert len(answers) == 50 and all(answer == answers[0] for answer in answers)


def test_the_page_names_all_its_modules_at_once(page):
    """Otherwise a browser finds each module only after loading the one that imports it."""
    text = page.get("/").text
    asked = set(re.findall(r'(?:rel="modulepreload" href|script type="module" src)="(/[\w/]+\.js)"', text))
    modules = (files("gsplat_edu.studio") / "web").iterdir()
    shared = {f"/viewer/web/{name}.js" for name in ("dropped", "patch", "words")}
    own = {f"/web/{path.name}" for path in modules if path.suffix == ".js"}
    assert asked == {"/web/questions.js"} | shared | own


def promised(page, wish, kind="photos"):
    answer = page.post("/api/names", json={"kind": kind, "wish": wish})
    assert answer.status_code == 200, answer.text
    return answer.json()["name"]


def test_a_promised_name_is_given_once(page, studio, jpeg):
    """Two tabs that wish for one name get two, before either has sent a file; a name that is given up is free again."""
    assert [promised(page, "walk"), promised(page, "walk")] == ["walk", "walk (2)"]
    assert page.put("/api/photos/walk/files/a.jpg", content=jpeg).status_code == 201
    page.delete("/api/names/photos/walk")
    page.delete("/api/names/photos/walk (2)")
    assert promised(page, "walk") == "walk (2)"
    assert page.post("/api/names", json={"kind": "films", "wish": "a"}).status_code == 400


@pytest.mark.parametrize("wish", [*NAMES, *REFUSED, "写" * 200, "e\u0301"], ids=ascii)
def test_any_wish_becomes_a_name_that_is_allowed(page, studio, jpeg, wish):
    name = promised(page, wish)
    assert page.put(f"/api/photos/{quoted(name)}/files/a.jpg", content=jpeg).status_code == 201
    assert listed(page, "photos") == [name] and (wish not in NAMES or name == wish)


def test_an_adopted_folder_needs_no_name(page, studio, tmp_path, jpeg):
    for place in ("a/trip: 1", "b/trip: 1"):
        (tmp_path / place).mkdir(parents=True)
    asked = [{"kind": "photos", "path": str(tmp_path / place / "trip: 1")} for place in "ab"]
    found = [page.post("/api/adopt", json=one).json() for one in asked]
    assert [one.get("name", one) for one in found] == ["trip_ 1", "trip_ 1 (2)"]


def test_a_name_that_a_waiting_job_will_take_is_not_free(page, studio):
    entry(studio, "captures", "box")
    entry(studio, "captures", "other")
    begun = page.post("/api/jobs", json={"command": "train", "subject": "captures/other", "to": "box"})
    assert begun.status_code == 200
    made = page.post("/api/jobs", json={"command": "train", "subject": "captures/box"}).json()
    assert made["work"]["outputs"] == ["runs/box-run-2"]
    assert page.post("/api/jobs", json={"command": "train", "subject": "captures/box"}).status_code == 409


def test_a_capture_without_poses_of_a_search_is_not_trained(page, studio, jpeg):
    folder = entry(studio, "captures", "bad", a__jpg=jpeg)
    (folder / "sfm").mkdir()
    assert page.get("/api/captures/bad").json()["unfinished"]
    for command in ("train", "doctor"):
        answer = page.post("/api/jobs", json={"command": command, "subject": "captures/bad"})
        assert (answer.status_code, "its photos are not placed yet" in answer.json()["error"]) == (409, True)
    (folder / "cameras.txt").touch()
    assert not page.get("/api/captures/bad").json()["unfinished"]
    assert page.post("/api/jobs", json={"command": "train", "subject": "captures/bad"}).status_code == 200


def test_entries_of_one_name_belong_together(page, studio, jpeg):
    """A second run or search is not named like a second set of photos, and new photos are not named like a run."""
    for kind, name in (("photos", "walk"), ("captures", "walk"), ("runs", "walk"), ("runs", "other")):
        entry(studio, kind, name, a__jpg=jpeg)
    run = page.post("/api/jobs", json={"command": "train", "subject": "captures/walk"}).json()
    search = page.post("/api/jobs", json={"command": "sfm", "subject": "photos/walk"}).json()
    assert run["work"]["outputs"] + search["work"]["outputs"] == ["runs/walk-run-2", "captures/walk-poses-2"]
    assert [promised(page, wish) for wish in ("walk", "other")] == ["walk (2)", "other (2)"]


def test_a_capture_says_what_the_search_for_its_poses_found(page, studio):
    folder = entry(studio, "captures", "box", cameras__txt=b"")
    assert page.get("/api/captures/box").json()["search"] is None
    (folder / "sfm").mkdir()
    found = {
        "photos": {"names": list("abc")},
        "mapping": {"names": list("ab")},
        "capture": {"error": 0.364, "left_out": ["c"]},
    }
    stages = {name: {"options": {}, "facts": facts} for name, facts in found.items()}
    file = folder / "sfm" / "stages.json"
    text = json.dumps({"stages": stages})
    file.write_text(text)
    assert page.get("/api/captures/box").json()["search"] == {
        "photos": 3,
        "posed": 2,
        "unplaced": ["c"],
        "beside": [["b", None]],
        "error": 0.364,
    }
    file.write_text(json.dumps({"stages": stages | {"faces": {"options": {}, "facts": {}}}}))
    assert page.get("/api/captures/box").json()["search"]["photos"] is None
    unfinished = json.dumps({"stages": stages | {"capture": {"options": {}, "facts": None}}})
    for damaged in ("[]", "{", unfinished, text.replace("0.364", "NaN")):
        file.write_text(damaged)
        assert page.get("/api/captures/box").json()["search"] is None


def test_what_vanishes_while_it_is_listed_is_left_out(page, studio, jpeg, monkeypatch):
    """Jobs replace and remove files, and other tabs rename entries, while a page reads the list."""
    for name in ("a", "b"):
        entry(studio, "photos", name, x__jpg=jpeg, y__jpg=jpeg)
    within = contents_module.files_within

    def vanishing(folder):
        for found in within(folder):
            path = folder / found[0]
            if path == studio.library.root / "photos" / "a" / "x.jpg":
                path.unlink()
            yield found

    monkeypatch.setattr(contents_module, "files_within", vanishing)
    (first, _) = page.get("/api/library").json()["photos"]
    assert (first["name"], first["files"], first["bytes"]) == ("a", 1, len(jpeg))

    def renamed(folder):
        if folder.name == "b":
            folder.rename(folder.with_name("c"))
        yield from within(folder)

    monkeypatch.setattr(contents_module, "files_within", renamed)
    answer = page.get("/api/library")
    assert answer.status_code == 200, answer.text
    assert [found["name"] for found in answer.json()["photos"]] == ["a"]
    assert scene_file(studio.library.root / "scenes" / "gone") is None
    assert newest_export(studio.library.root / "runs" / "gone") is None


def test_what_is_being_deleted_cannot_be_restored(studio, jpeg, monkeypatch):
    entry(studio, "photos", "a", x__jpg=jpeg)
    number = studio.library.remove("photos", "a")
    delete, refused = shutil.rmtree, []

    def slow(path, **options):
        with pytest.raises(RefusedError, match="trash/"):
            studio.library.restore(number)
        refused.append(number)
        delete(path, **options)

    monkeypatch.setattr(shutil, "rmtree", slow)
    studio.library.empty_trash()
    assert refused == [number] and studio.library.trash() == []
    assert list(studio.library.hidden("uploads").iterdir()) == []
