"""What was taken in is a capture if `train` reads its poses, of whatever program; otherwise it becomes photos."""

import pytest

from data import pose_programs as programs
from gsplat_edu.data.reader import layout_of
from scene_files import DATA
from studio.conftest import picture
from studio.test_uploads import zipped

WRITERS = {
    "OpenSfM": programs.write_opensfm,
    "Bundler": programs.write_bundler,
    "VisualSFM": programs.write_nvm,
    "RealityCapture": programs.write_table,
    "Metashape": programs.write_metashape,
    "OpenMVG": programs.write_openmvg,
    "Meshroom": programs.write_meshroom,
    "LLFF": programs.write_llff,
    "RealityCapture, XMP": programs.write_xmp,
    "Pix4D": programs.write_opf,
    "Polycam": programs.write_polycam,
    "Record3D": programs.write_record3d,
    "7-Scenes": programs.write_seven_scenes,
    "ScanNet": programs.write_scannet,
    "TUM": programs.write_tum,
}


def files_of(folder):
    """Return the files below a folder, by their path in it."""
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def settled(page, files, name="walk"):
    """Upload files one by one, as the page does, and ask what they are."""
    for path, data in files.items():
        assert page.put(f"/api/captures/{name}/files/{path}", content=data).status_code == 201
    return page.post(f"/api/captures/{name}/settle", json={})


@pytest.mark.parametrize("program", WRITERS)
@pytest.mark.parametrize("packed", [False, True], ids=["folder", "zip"])
def test_poses_of_any_program_make_a_capture(page, tmp_path, program, packed):
    WRITERS[program](tmp_path / "walk")
    files = files_of(tmp_path / "walk")
    if packed:
        data = zipped({f"walk/{path}": data for path, data in files.items()})
        assert page.put("/api/captures/walk/zip", content=data).status_code == 201
        files = {}
    answer = settled(page, files).json()
    assert answer == {"entry": "captures/walk", "left_out": [], "num_left_out": 0}
    assert page.get("/api/captures/walk").json()["layout"] == layout_of(tmp_path / "walk")
    assert page.get("/api/captures/walk/notes").json()["notes"][0].endswith("6 of 6 photos")


def test_files_that_are_no_poses_leave_photos(page, studio, jpeg):
    answer = settled(page, {"left/a.jpg": jpeg, "b.jpg": jpeg, "day/notes.txt": b"rain", "a.xmp": b"<x/>"})
    assert answer.json() == {
        "entry": "photos/walk",
        "left_out": ["a.xmp", "day/notes.txt"],
        "num_left_out": 2,
    }
    assert sorted(files_of(studio.library.root / "photos" / "walk")) == ["b.jpg", "left/a.jpg"]
    assert not (studio.library.root / "captures" / "walk").exists()


def test_the_cameras_of_photos_that_were_taken_in_have_their_name(page, studio, jpeg):
    name = page.post("/api/names", json={"kind": "captures", "wish": "walk"}).json()["name"]
    assert settled(page, {"a.jpg": jpeg}, name).json()["entry"] == "photos/walk"
    assert studio.library.free_name("captures", "walk", "poses") == "walk"


def test_neither_photos_nor_poses_go_to_the_trash(page, studio):
    answer = settled(page, {"notes.txt": b"rain"})
    assert answer.status_code == 400 and "neither photos nor poses" in answer.json()["error"]
    assert [removed["name"] for removed in page.get("/api/trash").json()["trash"]] == ["walk"]
    assert not (studio.library.root / "captures" / "walk").exists()


def test_places_elsewhere_and_searches_stay_as_they_are(page, studio, tmp_path, jpeg):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "a.jpg").write_bytes(jpeg)
    (tmp_path / "elsewhere" / "notes.txt").write_bytes(b"rain")
    page.post("/api/adopt", json={"kind": "captures", "path": str(tmp_path / "elsewhere"), "name": "own"})
    assert page.post("/api/captures/own/settle", json={}).status_code == 409
    assert sorted(files_of(tmp_path / "elsewhere")) == ["a.jpg", "notes.txt"]
    answer = settled(page, {"a.jpg": jpeg, "sfm/stages.json": b"{}"})
    assert answer.json()["entry"] == "captures/walk"


def test_a_capture_that_was_there_before_keeps_its_files(page, studio, jpeg):
    before = studio.library.root / "captures" / "walk"
    before.mkdir()
    (before / "a.jpg").write_bytes(jpeg)
    (before / "notes.txt").write_bytes(b"rain")
    for _ in range(2):  # also after a file was added
        answer = settled(page, {"b.jpg": jpeg} if not (before / "b.jpg").exists() else {})
        assert answer.json() == {"entry": "captures/walk", "left_out": [], "num_left_out": 0}
    assert sorted(files_of(before)) == ["a.jpg", "b.jpg", "notes.txt"]


def test_the_screen_says_which_pose_files_are_read(page, tmp_path):
    programs.write_opensfm(tmp_path / "walk")
    programs.write_nvm(tmp_path / "walk", programs.CAMERAS[:4])
    assert settled(page, files_of(tmp_path / "walk")).json()["entry"] == "captures/walk"
    said = page.get("/api/captures/walk/notes").json()["notes"]
    assert said[0] == "Poses of OpenSfM: 6 of 6 photos"
    assert (
        said[1].startswith("reconstruction.json (6 photos) is read") and "any name.nvm (4 photos)" in said[1]
    )


def test_a_real_capture_of_opensfm_is_taken_in(page):
    real = DATA / "poses" / "opensfm"
    if not real.is_dir():
        pytest.skip("needs the poses of real captures in shared/data/poses")
    photo = picture("JPEG", (8, 6))
    files = {path: photo if path.endswith(".jpg") else data for path, data in files_of(real).items()}
    assert settled(page, files).json()["entry"] == "captures/walk"
    assert page.get("/api/captures/walk").json()["layout"] == "OpenSfM"
