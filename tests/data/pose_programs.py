"""Files with poses as other programs write them, and where such a program's documentation says a point is seen.

Nothing here uses a reader. Positions have the centre of the first pixel at (0.5, 0.5).
"""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.lens_formulas import FORMULAS
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.reader import read_capture

W, H = 24, 18
OPENGL = np.diag([1.0, -1.0, -1.0])
COLORS = (255.0, 128.0, 0.0)

views, POINTS, _ = procedural_capture(W, 6, splats=40)
CAMERAS = [
    (f"shot_{i}.png", np.array(view.camera.R), np.array(view.camera.eye)) for i, view in enumerate(views)
]


def write_photos(folder: Path, count: int = len(CAMERAS)) -> None:
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for name, _, _ in CAMERAS[:count]:
        Image.new("RGB", (W, H), (60, 90, 120)).save(folder / "images" / name)


def rays(R, eye):
    seen = (POINTS - eye) @ R.T
    return seen[:, 0] / seen[:, 2], seen[:, 1] / seen[:, 2]


def assert_reads(folder: Path, program: str, seen, count: int = len(CAMERAS), called=str):
    """Check poses, and the positions in the photos, which `seen` returns for two arrays of rays; return the capture.

    `called` returns the name in the capture of a photo of `CAMERAS`.
    """
    capture = read_capture(folder)
    assert capture.layout == program and len(capture.frames) == count
    assert str(capture.notes[0]) == f"poses of {program}: {count} of {count} photos"
    frames = {frame.name: frame for frame in capture.frames}
    for name, R, eye in CAMERAS[:count]:
        frame = frames[called(name)]
        np.testing.assert_allclose(frame.R, R, rtol=0, atol=1e-9)
        np.testing.assert_allclose(frame.eye, eye, rtol=0, atol=1e-9)
        x, y = rays(frame.R, frame.eye)
        formula, lens = FORMULAS[frame.lens.model], frame.lens
        c = np.array([*lens.coefficients, *[0.0] * (len(formula.names) - len(lens.coefficients))])
        a, b = formula.image(x, y, c)
        expected = seen(*rays(R, eye))
        np.testing.assert_allclose(lens.fx * a + lens.cx + 0.5, expected[0], rtol=0, atol=1e-3)
        np.testing.assert_allclose(lens.fy * b + lens.cy + 0.5, expected[1], rtol=0, atol=1e-3)
    return capture


def write_opensfm(folder: Path, cameras=CAMERAS, camera=None, extra=()):
    write_photos(folder)
    camera = camera or {"projection_type": "perspective", "focal": 0.9, "k1": -0.1, "k2": 0.02}
    shots = {
        name: {
            "camera": "v2 any",
            "rotation": Rotation.from_matrix(R).as_rotvec().tolist(),
            "translation": (-R @ eye).tolist(),
            "orientation": 1,
        }
        for name, R, eye in cameras
    }
    points = {str(i): {"coordinates": p.tolist(), "color": COLORS} for i, p in enumerate(POINTS)}
    one = {"cameras": {"v2 any": {"width": W, "height": H, **camera}}, "shots": shots, "points": points}
    (folder / "reconstruction.json").write_text(json.dumps([*extra, one]))


def write_bundler(folder: Path, cameras=CAMERAS, f=20.0, k1=-0.1, k2=0.02):
    write_photos(folder)
    lines = ["# Bundle file v0.3", f"{len(cameras)} {len(POINTS)}"]
    for _, R, eye in cameras:
        down = OPENGL @ R
        lines.append(f"{f} {k1} {k2}")
        lines += [" ".join(map(repr, row)) for row in [*down.tolist(), (-down @ eye).tolist()]]
    for point in POINTS.tolist():
        lines += [" ".join(map(repr, point)), "255 128 0", "1 0 0 0.5 -0.5"]
    (folder / "bundle.out").write_text("\n".join(lines) + "\n")
    (folder / "list.txt").write_text("".join(f"./{name} 0 {f}\n" for name, _, _ in cameras))


def write_nvm(folder: Path, cameras=CAMERAS, f=20.0, r=-0.05, first="NVM_V3"):
    write_photos(folder)
    lines = [first, "", str(len(cameras))]
    for name, R, eye in cameras:
        x, y, z, w = Rotation.from_matrix(R).as_quat()
        numbers = (f, w, x, y, z, *eye, r, 0)
        lines.append(f"images\\{name}\t" + " ".join(str(float(v)) for v in numbers))
    lines += ["", str(len(POINTS))]
    lines += [" ".join(map(repr, p)) + " 255 128 0 1 0 5 0.5 -0.5" for p in POINTS.tolist()]
    (folder / "any name.nvm").write_text("\n".join([*lines, "", "0", "0"]) + "\n")


RC_LENS = {
    "f": 33.0,
    "px": 0.02,
    "py": -0.03,
    "k1": -0.1,
    "k2": 0.02,
    "k3": -0.004,
    "k4": 0,
    "t1": 0.003,
    "t2": -0.002,
}
RC_NUMBERS = ("name", "x", "y", "alt", "heading", "pitch", "roll", *RC_LENS)


def write_table(folder: Path, cameras=CAMERAS, columns=RC_NUMBERS, lens=RC_LENS, count="#cameras 6\n"):
    """Angles as the documentation of the program defines them, by SciPy."""
    write_photos(folder)
    lines = ["#" + ",".join(columns)]
    for name, R, eye in cameras:
        gl = (OPENGL @ R).T
        heading, pitch, roll = Rotation.from_matrix(gl).as_euler("ZXY", degrees=True)
        kappa, phi, omega = Rotation.from_matrix(gl).as_euler("YXZ", degrees=True)
        row = {"name": name, "x": eye[0], "y": eye[1], "alt": eye[2], "z": eye[2]}
        row |= {
            "heading": -heading,
            "pitch": pitch,
            "roll": roll,
            "omega": -omega,
            "phi": phi,
            "kappa": kappa,
        }
        lines.append(",".join(f"{value}" for value in ({**row, **lens}[column] for column in columns)))
    (folder / "cameras.csv").write_text(count + "\n".join(lines) + "\n")


XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/">
  <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
    <rdf:Description xcr:Version="3" xcr:DistortionModel="brown3t2" xcr:FocalLength35mm="{f}" xcr:Skew="0"
       xcr:AspectRatio="1" xcr:PrincipalPointU="{px}" xcr:PrincipalPointV="{py}"
       xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#">
      <xcr:Rotation>{R}</xcr:Rotation>
      <xcr:Position>{eye}</xcr:Position>
      <xcr:DistortionCoeficients>{k1} {k2} {k3} {k4} {t1} {t2}</xcr:DistortionCoeficients>
    </rdf:Description>
  </rdf:RDF>
</x:xmpmeta>
"""


def write_xmp(folder: Path, cameras=CAMERAS):
    write_photos(folder)
    for name, R, eye in cameras:
        pose = {"R": " ".join(map(str, R.ravel())), "eye": " ".join(map(str, eye))}
        (folder / "images" / name).with_suffix(".xmp").write_text(XMP.format(**RC_LENS, **pose))


MS_LENS = {
    "f": 20.0,
    "cx": 0.4,
    "cy": -0.3,
    "b1": 1.5,
    "k1": -0.1,
    "k2": 0.02,
    "k3": -0.004,
    "p1": 0.003,
    "p2": -0.002,
}


def write_metashape(folder: Path, cameras=CAMERAS, kind="frame", lens=MS_LENS, more=""):
    """Chunk coordinates are turned, shrunk and moved against those of the world."""
    write_photos(folder)
    turn, scale, shift = Rotation.from_rotvec([0.3, -0.5, 0.9]).as_matrix(), 2.5, np.array([4.0, -7.0, 2.0])
    numbers = "".join(f"<{name}>{value}</{name}>" for name, value in lens.items())
    rows = []
    for number, (name, R, eye) in enumerate(cameras):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn.T @ R.T, turn.T @ (eye - shift) / scale
        text = " ".join(map(str, pose.ravel()))
        label = name.removesuffix(".png")
        rows.append(
            f'<camera id="{number}" sensor_id="1" label="{label}"><transform>{text}</transform></camera>'
        )
    (folder / "cameras.xml").write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="1.5.0"><chunk label="one"><sensors>'
        '<sensor id="0" type="frame"/>'
        f'<sensor id="1" type="{kind}"><resolution width="{W}" height="{H}"/>'
        f'<calibration type="{kind}" class="initial"><f>1</f></calibration>'
        f'<calibration type="{kind}" class="adjusted"><resolution width="{W}" height="{H}"/>{numbers}</calibration>'
        f"</sensor></sensors><cameras>{''.join(rows)}{more}</cameras><transform>"
        f'<rotation locked="1">{" ".join(map(str, turn.ravel()))}</rotation>'
        f"<translation>{' '.join(map(str, shift))}</translation><scale>{scale}</scale></transform></chunk></document>\n"
    )


MVG_LENS = {
    "focal_length": 20.0,
    "principal_point": [12.4, 8.7],
    "disto_t2": [-0.1, 0.02, -0.004, 0.003, -0.002],
}


def write_openmvg(folder: Path, cameras=CAMERAS, kind="pinhole_brown_t2", lens=MVG_LENS):
    """The first entry of a class has its name; the second intrinsic has only its number, and no view uses the third."""
    write_photos(folder)
    data = {"width": W, "height": H, **lens}
    named = {
        "polymorphic_id": 2**31 + 1,
        "polymorphic_name": kind,
        "ptr_wrapper": {"id": 2**31, "data": data},
    }
    other = {
        "polymorphic_id": 2**31 + 2,
        "polymorphic_name": "made up",
        "ptr_wrapper": {"id": 9, "data": data},
    }
    later = {"polymorphic_id": 1, "ptr_wrapper": {"id": 7, "data": data}}
    views = [
        {"filename": name, "local_path": "", "id_view": i, "id_intrinsic": i % 2, "id_pose": 10 + i}
        for i, (name, _, _) in enumerate(cameras)
    ]
    unposed = {"filename": "later.png", "id_view": 99, "id_intrinsic": 0, "id_pose": 2**32 - 1}
    contents = {
        "sfm_data_version": "0.3",
        "root_path": "/elsewhere/images",
        "views": [
            {"key": i, "value": {"polymorphic_id": 2**30, "ptr_wrapper": {"id": i, "data": view}}}
            for i, view in enumerate([*views, unposed])
        ],
        "intrinsics": [{"key": i, "value": value} for i, value in enumerate((named, later, other))],
        "extrinsics": [
            {"key": 10 + i, "value": {"rotation": R.tolist(), "center": eye.tolist()}}
            for i, (_, R, eye) in enumerate(cameras)
        ],
        "structure": [
            {"key": i, "value": {"X": p.tolist(), "observations": []}} for i, p in enumerate(POINTS)
        ],
    }
    (folder / "sfm_data.json").write_text(json.dumps(contents))


def llff_rows(cameras):
    """Columns: down, right, backward, centre, and height, width and focal length; then two depths."""
    rows = []
    for _, R, eye in cameras:
        right, down, forward = R
        matrix = np.stack([down, right, -forward, eye, [H, W, 20.0]], axis=1)
        rows.append([*matrix.ravel(), 0.1, 100.0])
    return np.array(rows)


def write_llff(folder: Path, cameras=CAMERAS):
    write_photos(folder)
    np.save(folder / "poses_bounds.npy", llff_rows(cameras))


SFM_LENS = {
    "type": "pinhole",
    "distortionType": "brown",
    "distortionParams": ["-0.1", "0.02", "-0.004", "0.003", "-0.002"],
    "principalPoint": ["0.4", "-0.3"],
    "sensorWidth": "36",
    "focalLength": "30",
    "pixelRatio": "1.05",
}


def write_meshroom(folder: Path, cameras=CAMERAS, lens=SFM_LENS, version="1 2 8"):
    """All numbers are texts; Eigen stores the columns of the world-to-camera rotation one after the other."""
    write_photos(folder)

    def texts(values):
        return [repr(float(v)) for v in values]

    views = [
        {
            "viewId": f"{40 + i}",
            "poseId": f"{40 + i}",
            "intrinsicId": "7",
            "path": f"/elsewhere/images/{name}",
        }
        for i, (name, _, _) in enumerate(cameras)
    ]
    poses = [
        {
            "poseId": f"{40 + i}",
            "pose": {
                "transform": {"rotation": texts(R.ravel(order="F")), "center": texts(eye)},
                "locked": "0",
            },
        }
        for i, (_, R, eye) in enumerate(cameras)
    ]
    intrinsic = {"intrinsicId": "7", "width": str(W), "height": str(H), "serialNumber": "", **lens}
    contents = {
        "version": version.split(),
        "views": [*views, {"viewId": "1", "poseId": "1", "intrinsicId": "7", "path": "later.png"}],
        "intrinsics": [intrinsic],
        "poses": poses,
        "structure": [
            {"landmarkId": f"{i}", "color": ["255", "128", "0"], "X": texts(p)} for i, p in enumerate(POINTS)
        ],
    }
    (folder / "cameras.sfm").write_text(json.dumps(contents, indent=4))


OPF_LENS = {
    "type": "perspective",
    "principal_point_px": [12.4, 8.7],
    "focal_length_px": 20.0,
    "radial_distortion": [-0.1, 0.02, -0.004],
    "tangential_distortion": [0.003, -0.002],
}


def write_opf(folder: Path, cameras=CAMERAS, lens=OPF_LENS):
    """Angles of intrinsic turns about x, y and z, by SciPy."""
    write_photos(folder)
    rows = [
        {
            "id": 100 + i,
            "sensor_id": 5,
            "position": eye.tolist(),
            "orientation_deg": Rotation.from_matrix((OPENGL @ R).T).as_euler("XYZ", degrees=True).tolist(),
        }
        for i, (_, R, eye) in enumerate(cameras)
    ]
    calibrated = {"format": "application/opf-calibrated-cameras+json", "version": "1.0"}
    calibrated |= {"sensors": [{"id": 5, "internals": lens}], "cameras": rows}
    (folder / "calibrated_cameras.json").write_text(json.dumps(calibrated))
    uris = [
        {"id": 100 + i, "uri": f"file:///c:/my%20photos/{name}"} for i, (name, _, _) in enumerate(cameras)
    ]
    listed = {"format": "application/opf-camera-list+json", "version": "1.0", "cameras": uris}
    (folder / "camera_list.json").write_text(json.dumps(listed))


def camera_to_world(R, eye, axes):
    """Return the 4x4 pose of a camera with these axes instead of OpenCV's."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = (axes @ R).T, eye
    return pose


def write_photo(path: Path, size=(W, H)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size, (60, 90, 120)).save(path)


def write_rows(path: Path, rows) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(" ".join(map(repr, map(float, row))) + "\n" for row in rows))


def polycam_name(name):
    return f"keyframes/corrected_images/{name.replace('png', 'jpg')}"


def write_polycam(folder: Path, cameras=CAMERAS, kind="corrected_"):
    """Depth maps have the photos' names."""
    for name, R, eye in cameras:
        pose = camera_to_world(R, eye, OPENGL)
        contents = {f"t_{i}{j}": pose[i, j] for i in range(3) for j in range(4)}
        contents |= {
            "fx": 20.0,
            "fy": 21.0,
            "cx": 12.4,
            "cy": 8.7,
            "width": W,
            "height": H,
            "blur_score": 9.0,
        }
        stem = name.removesuffix(".png")
        write_photo(folder / f"keyframes/{kind}images/{stem}.jpg")
        write_photo(folder / f"keyframes/depth/{stem}.png")
        path = folder / f"keyframes/{kind}cameras/{stem}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(contents))


def numbered(name):
    return name.removeprefix("shot_").removesuffix(".png")


def write_record3d(folder: Path, cameras=CAMERAS, photos="rgbd", metadata="metadata", **more):
    poses = []
    for name, R, eye in cameras:
        q = Rotation.from_matrix(camera_to_world(R, eye, OPENGL)[:3, :3]).as_quat()
        poses.append([*q.tolist(), *eye.tolist()])
        write_photo(folder / photos / f"{numbered(name)}.jpg")
    K = np.array([[20.0, 0, 12.4], [0, 21.0, 8.7], [0, 0, 1]])
    contents = {"w": W, "h": H, "fps": 60, "K": K.ravel(order="F").tolist(), "poses": poses, **more}
    (folder / metadata).write_text(json.dumps(contents))


def write_seven_scenes(folder: Path, cameras=CAMERAS):
    for name, R, eye in cameras:
        stem = f"frame-{int(numbered(name)):06d}"
        write_photo(folder / f"{stem}.color.png", (640, 480))
        write_photo(folder / f"{stem}.depth.png", (640, 480))
        write_rows(folder / f"{stem}.pose.txt", camera_to_world(R, eye, np.eye(3)))


def write_scannet(folder: Path, cameras=CAMERAS):
    K = np.diag([20.0, 21.0, 1.0, 1.0])
    K[:2, 2] = 12.4, 8.7
    write_rows(folder / "intrinsic/intrinsic_color.txt", K)
    for name, R, eye in cameras:
        write_photo(folder / f"color/{numbered(name)}.jpg")
        write_photo(folder / f"depth/{numbered(name)}.png")
        write_rows(folder / f"pose/{numbered(name)}.txt", camera_to_world(R, eye, np.eye(3)))


def tum_time(name):
    return 1305031102.1758 + 0.5 * int(numbered(name))


def write_tum(folder: Path, cameras=CAMERAS, lens=(20.0, 21.0, 11.9, 8.2), rgb="rgb.txt"):
    """Between the poses of the photos there are others; the photos are 4 ms late."""
    rows = ["# timestamp tx ty tz qx qy qz qw"]
    photos = ["# timestamp filename"]
    for name, R, eye in cameras:
        q = Rotation.from_matrix(R.T).as_quat()
        write_photo(folder / "rgb" / f"{tum_time(name) + 0.004:.6f}.png")
        photos.append(f"{tum_time(name) + 0.004:.6f} rgb/{tum_time(name) + 0.004:.6f}.png")
        rows.append(" ".join(map(repr, map(float, (tum_time(name), *eye, *q)))))
        rows.append(" ".join(map(repr, map(float, (tum_time(name) + 0.01, *(eye + 1), 0, 0, 0, 1)))))
    (folder / "groundtruth.txt").write_text("\n".join(rows) + "\n")
    (folder / "calibration.txt").write_text(" ".join(map(str, lens)) + "\n")
    if rgb:
        (folder / rgb).write_text("\n".join(photos) + "\n")


WRITERS = {
    "OpenSfM": write_opensfm,
    "Bundler": write_bundler,
    "VisualSFM": write_nvm,
    "RealityCapture": write_table,
    "Metashape": write_metashape,
    "OpenMVG": write_openmvg,
    "Meshroom": write_meshroom,
    "Pix4D": write_opf,
    "LLFF": write_llff,
    "Polycam": write_polycam,
    "Record3D": write_record3d,
    "7-Scenes": write_seven_scenes,
    "ScanNet": write_scannet,
    "TUM": write_tum,
}
"""A writer for each program: of a folder and, if they are not `CAMERAS`, its cameras."""


def assert_refused(path: Path, change, says: str) -> None:
    """Change the contents of a capture's JSON file; the capture is refused in one line that names the file.

    Args:
        path: The file, in the capture's folder.
        change: Changes its contents in place.
        says: Expression that the line matches.
    """
    contents = json.loads(path.read_text())
    change(contents)
    path.write_text(json.dumps(contents))
    with pytest.raises(DatasetError, match=says) as caught:
        read_capture(path.parent)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)
