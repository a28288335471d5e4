from dataclasses import replace

from bag_writers import camera_image, full_turn, SECOND, START, write_sweep
import cv2
import numpy as np
import pytest
from scenes import draw_cylinder, draw_sweep, rectangle_room, textured_room, turn_sweep

from landmark_nav.cli.main import main
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.learning.capture.frames import look_at, relative_sharpness
from landmark_nav.learning.panorama.photometry import even_out, measure_photometry
from landmark_nav.learning.panorama.synthesis import synthesize_cylinder
from landmark_nav.storage.bags import BagWriter
from landmark_nav.types import CameraFrame, Sweep

LENS = CameraModel(
    200, 160, 180.0, 181.0, 101.5, 77.0, distortion=(-0.24, 0.07, 0.002, -0.001, 0.0)
)
FISHEYE = CameraModel(200, 160, 120.0, 120.0, 99.0, 80.0, 'equidistant', (0.02, -0.01, 0.0, 0.0))
MOUNT = PanTiltMount(axis_xyz=(0.1, -0.02, 1.0))
TURN = np.radians(np.arange(0, 360, 20))


def sky(directions):
    """BGR (..., 3) of far things: smooth waves over azimuth and elevation."""
    azimuth = np.arctan2(directions[..., 1], directions[..., 0])
    tangent = directions[..., 2] / np.hypot(directions[..., 0], directions[..., 1])
    blue = 128.0 + 60.0 * np.sin(17.0 * azimuth + 1.0) * np.cos(11.0 * tangent)
    green = 120.0 + 60.0 * np.sin(9.0 * azimuth - 14.0 * tangent)
    red = 110.0 + 50.0 * np.cos(5.0 * azimuth) + 40.0 * np.sin(23.0 * tangent + 3.0 * azimuth)
    return np.stack([blue, green, red], -1)


def sky_frame(camera, pan, tilt=0.0):
    rotation, _ = MOUNT.camera_pose_base(pan, tilt)
    rays = np.concatenate([camera.ray_grid, np.ones((camera.height, camera.width, 1))], -1)
    image = np.clip(np.rint(sky(rays @ rotation.T)), 0, 255).astype(np.uint8)
    return CameraFrame(0, image, camera, float(pan), tilt)


def sky_sweep(camera, pans, tilt=0.0):
    return Sweep(0, tuple(sky_frame(camera, pan, tilt) for pan in pans))


def errors(view):
    """Absolute differences (n,) from the sky, of covered pixels, worst of their channels."""
    columns, rows = np.meshgrid(np.arange(view.cylinder.width), np.arange(view.cylinder.height))
    expected = sky(view.cylinder.rays(np.stack([columns, rows], -1)))
    return np.asarray(np.abs(view.image - expected).max(axis=-1)[view.mask])


@pytest.mark.parametrize('feathered', [False, True])
@pytest.mark.parametrize(
    ('camera', 'tilt', 'start'),
    [(LENS, 0.0, 0.0), (LENS, 0.12, 2.9), (LENS, -0.2, -40.0), (FISHEYE, 0.05, 1.0)],
)
def test_a_cylinder_shows_what_the_frames_saw(feathered, camera, tilt, start):
    sweep = sky_sweep(camera, start + TURN, tilt)
    view = synthesize_cylinder(sweep, MOUNT, feathered=feathered)
    middle = slice(view.mask.shape[0] // 4, -view.mask.shape[0] // 4)
    assert view.mask[middle].all()
    # No frame is continued past its border, no seam is left: the worst pixel is right too.
    error = errors(view)
    assert error.mean() < 1.0
    assert error.max() < 8.0


def test_the_median_removes_a_person_in_two_of_ten_frames():
    pans = np.radians(np.linspace(-12.0, 12.0, 10))
    frames = list(sky_sweep(LENS, pans).frames)
    for k, left in ((3, 60), (4, 75)):
        image = frames[k].image.copy()
        image[20:150, left : left + 40] = (250, 250, 0)
        frames[k] = replace(frames[k], image=image)
    sweep = Sweep(0, tuple(frames))
    worst = {}
    for feathered in (False, True):
        view = synthesize_cylinder(sweep, MOUNT, feathered=feathered)
        azimuth = view.cylinder.azimuth_rad(np.arange(view.cylinder.width))
        # At least five frames look there.
        shared = np.broadcast_to(np.abs(azimuth) < np.radians(12.0), view.mask.shape)
        seen = replace(view, mask=view.mask & shared)
        seen.mask[:20], seen.mask[-20:] = False, False
        worst[feathered] = errors(seen).max()
    assert worst[False] < 12.0
    assert worst[True] > 20.0


@pytest.mark.parametrize('offset', [(0.08, 0.0, 0.0), (0.03, -0.06, 0.05)])
def test_a_camera_off_its_axis_sees_one_room_if_the_range_is_known(offset):
    room = rectangle_room(4.0, 3.0)
    scene = textured_room(room, seed=1, feature_m=0.05)
    mount = PanTiltMount((0.0, 0.0, 1.2), optical_center_offset=offset)
    camera = CameraModel(160, 120, 140.0, 140.0, 80.0, 60.0)
    pose = np.array([1.6, 1.4, 0.5])
    sweep = draw_sweep(scene, camera, mount, pose, TURN)

    def range_m(azimuth_rad, tangent=None):
        return room.raycast(pose[:2], azimuth_rad + pose[2])[0]

    error = {}
    for known in (True, False):
        view = synthesize_cylinder(sweep, mount, range_m if known else None)
        center = np.array([pose[0], pose[1], 1.2 + offset[2]])
        expected = draw_cylinder(scene, view.cylinder, center, pose[2])
        height = room.walls[0].height
        columns = np.arange(view.cylinder.width)
        reach = range_m(view.cylinder.azimuth_rad(columns))
        rows = np.arange(view.cylinder.height)[:, None]
        up = center[2] + reach * view.cylinder.tangent(rows)
        wall = view.mask & (up > 0.1) & (up < height - 0.1)
        error[known] = np.abs(view.image.astype(float) - expected)[wall].mean()
    assert error[True] < 2.0
    assert error[False] > 3.0 * error[True]


@pytest.fixture(params=[True, False])
def bag(tmp_path, request):
    """Two sweeps, of 24 and 18 frames, with their trajectory or joint states alone."""
    with BagWriter(tmp_path / 'learn') as bag:
        write_sweep(bag, START, full_turn(), trajectory=request.param)
        write_sweep(bag, START + 60 * SECOND, full_turn(18), trajectory=request.param)
    return tmp_path / 'learn'


def panorama(source, *options):
    out = source.parent / 'out.png'
    command = ['panorama', str(source), '--out', str(out), '--overwrite', '--no-align']
    return main([*command, *options])


def test_of_two_sweeps_one_is_chosen(bag, capsys):
    assert panorama(bag) == 2
    assert 'holds 2 sweeps: take one by --sweep 1 to 2' in capsys.readouterr().err
    for number, frames in (('1', 24), ('2', 18)):
        assert panorama(bag, '--sweep', number) == 0
        assert f'{frames} frames' in capsys.readouterr().out
    assert panorama(bag, '--sweep', '0') == 2
    assert panorama(bag, '--sweep', '3') == 2
    assert 'holds 2 sweeps, no number 3: take' in capsys.readouterr().err


def test_an_image_that_is_missing_is_reported_in_one_line(tmp_path, capfd):
    cv2.imwrite(str(tmp_path / '0.png'), camera_image(5))
    assert panorama(tmp_path) == 1
    assert 'images without frames.csv (file,pan_rad' in capfd.readouterr().err
    rows = ['file,pan_rad,focal_px,width,height', '0.png,0,60,64,48', 'gone.png,0.3,60,64,48']
    (tmp_path / 'frames.csv').write_text('\n'.join(rows))
    assert panorama(tmp_path) == 1
    reported = capfd.readouterr().err
    assert reported.startswith('landmark-nav panorama: ')
    assert reported.count('\n') == 1
    assert 'gone.png: cannot be read: No such file' in reported
    assert panorama(tmp_path, '--sweep', '1') == 2
    assert 'is one sweep: leave out --sweep 1' in capfd.readouterr().err


CENTRED = PanTiltMount()
CAMERA = CameraModel(240, 200, 230.0, 230.0, 112.0, 101.0)
PANS = -np.pi + np.radians(12.0) * np.arange(30)


@pytest.fixture(scope='module')
def even():
    return turn_sweep(CAMERA, CENTRED, PANS)


def taken(sweep, gains, vignetting, noise=2.0):
    """The same with exposures, light lost in the corners as 1 - v r^2, and noise."""
    rng = np.random.default_rng(3)
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    square = (u - CAMERA.cx) ** 2 + (v - CAMERA.cy) ** 2
    falloff = (1.0 - vignetting * square / square.max())[..., None]
    frames = []
    for frame, gain in zip(sweep.frames, gains, strict=True):
        grey = 0.6 * frame.image * falloff * gain + rng.normal(0.0, noise, frame.image.shape)
        frames.append(replace(frame, image=np.clip(np.rint(grey), 0, 255).astype(np.uint8)))
    return replace(sweep, frames=tuple(frames))


def test_exposures_and_vignetting_are_recovered(even):
    gains = np.exp(np.random.default_rng(1).normal(0.0, 0.08, len(PANS)))
    sweep = taken(even, gains, 0.3)
    found = measure_photometry(sweep, CENTRED)
    assert found.vignetting == pytest.approx(0.3, abs=0.02)
    np.testing.assert_allclose(found.gain, gains / np.exp(np.log(gains).mean()), atol=0.02)
    mended = even_out(sweep, found)
    scale = np.exp(np.log(gains).mean())
    for k in (0, 7, 20):
        corner = (slice(0, 40), slice(0, 40))
        ratio = mended.frames[k].image[corner].mean() / even.frames[k].image[corner].mean()
        assert ratio == pytest.approx(0.6 * scale, rel=0.04)


NARROW = CameraModel(256, 192, 280.0, 280.0, 127.5, 95.5)
LEVEL = PanTiltMount()
UPSIDE_DOWN = PanTiltMount(axis_rpy=(np.pi, 0.0, 0.0))
STEP = np.radians(5.0)
RAYS = NARROW.unproject(np.stack(np.meshgrid(np.arange(256.0), np.arange(192.0)), -1))


def texture(rng, blank=0.0):
    """A wall, 1600 px wide, around the turn; the share `blank` of it shows nothing."""
    layers = [
        cv2.resize(rng.normal(0.0, 1.0, (600 // s, 1600 // s)), (1600, 600)) for s in (4, 9, 25)
    ]
    wall = 120.0 + 25.0 * np.sum(layers, axis=0)
    wall[:, : int(blank * 1600)] = 120.0
    return wall.astype(np.float32)


def view(wall, pan, rng, mount=LEVEL, blur=None, gain=1.0):
    """What the camera sees of the wall, on a cylinder of 400 px per radian."""
    rays = RAYS @ mount.camera_pose_base(pan)[0].T
    x = 800.0 - 250.0 * np.arctan2(rays[..., 1], rays[..., 0])
    y = 300.0 - 250.0 * rays[..., 2] / np.hypot(rays[..., 0], rays[..., 1])
    image = cv2.remap(
        wall, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_WRAP,
    )  # fmt: skip
    if blur is not None:
        image = cv2.filter2D(image, -1, blur)
    image = gain * image + rng.normal(0.0, 2.0, image.shape)
    return np.clip(image, 0, 255).astype(np.uint8)


GAUSS = cv2.getGaussianKernel(13, 2.0)
BLURS = {
    'defocus': GAUSS @ GAUSS.T,
    'across': np.full((1, 7), 1 / 7),
    'down': np.full((7, 1), 1 / 7),
}


@pytest.mark.parametrize('mount', [LEVEL, UPSIDE_DOWN])
@pytest.mark.parametrize('seed', range(2))
def test_neighbours_are_as_sharp_as_each_other(seed, mount):
    rng = np.random.default_rng(seed)
    wall = texture(rng, blank=0.5)
    for pan in np.radians(np.arange(-120.0, 120.0, 20.0)):
        here = look_at(view(wall, pan, rng, mount, gain=0.8), NARROW)
        there = look_at(view(wall, pan + STEP, rng, mount), NARROW)
        # Upside down the camera turns the other way, and the pan is given as the joint has it.
        assert 0.8 < relative_sharpness(here, there, -STEP) < 1.25


@pytest.mark.parametrize('kind', BLURS)
@pytest.mark.parametrize('seed', range(4))
def test_a_blurred_image_is_not(kind, seed):
    rng = np.random.default_rng(seed)
    wall = texture(rng)
    here = look_at(view(wall, 0.3, rng, blur=BLURS[kind]), NARROW)
    there = look_at(view(wall, 0.3 + STEP, rng), NARROW)
    assert relative_sharpness(here, there, -STEP) < 0.6
