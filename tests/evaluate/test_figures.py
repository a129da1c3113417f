import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.image import imread

from gsplat_edu.evaluate.figures import curves_figure, held_out_figure, run_curve_figures, save_figure


def test_panels_show_the_images_given_clipped(tmp_path):
    bright, dark = np.full((8, 8, 3), 2.0), np.full((8, 8, 3), -1.0)
    save_figure(tmp_path / "x.png", held_out_figure([("bright", bright), ("dark", dark)]))
    pixels = imread(tmp_path / "x.png")[..., :3]
    height, width, _ = pixels.shape
    assert (pixels[height // 2, width // 4] == 1).all()
    assert (pixels[height // 2, 3 * width // 4] == 0).all()


def test_the_first_row_of_an_image_is_at_the_top(tmp_path):
    image = np.zeros((8, 8, 3))
    image[:4] = 1.0
    save_figure(tmp_path / "x.png", held_out_figure([("half", image)]))
    column = imread(tmp_path / "x.png")[:, :, 0]
    height, width = column.shape
    assert column[height * 2 // 5, width // 2] == 1 and column[height * 4 // 5, width // 2] == 0


def test_curves_are_labelled_and_hold_the_numbers():
    figure = curves_figure([0.3, 0.2, 0.1], [4, 4, 7])
    loss, count = figure.axes
    np.testing.assert_array_equal(loss.lines[0].get_ydata(), [0.3, 0.2, 0.1])
    np.testing.assert_array_equal(count.lines[0].get_ydata(), [4, 4, 7])
    for axes in (loss, count):
        assert axes.get_title() and axes.get_xlabel() and axes.get_ylabel()
    assert loss.get_yscale() == "log"


def test_the_curves_of_a_run_share_their_iterations_and_cut_off_outliers():
    """A single evaluation at iteration 5,000 used to get an axis from 4,800 to 5,200, and one pause flattened all
    speeds."""
    log = [{"iteration": 50 * i, "loss": 1.0 / i, "ms": 20.0 + i % 3} for i in range(1, 101)]
    log[40]["ms"] = 6000.0
    log.append({"iteration": 5000, "psnr": 30.0})
    loss, psnr, speed = (figure.axes[0] for figure in run_curve_figures(log))
    assert loss.get_xlim() == psnr.get_xlim() == speed.get_xlim()
    assert psnr.get_xlim()[0] == 0 and 5000 < psnr.get_xlim()[1] < 5200
    assert speed.get_ylim() == (0, 44) and "up to 6,000 ms are cut off" in speed.get_title()
    ((even,),) = [f.axes for f in run_curve_figures([{"iteration": i, "ms": 20.0 + i % 3} for i in (1, 2)])]
    assert even.get_title() == "speed" and even.get_ylim()[1] > 22


def test_a_count_that_hardly_changes_is_not_drawn_on_the_edge():
    log = [{"iteration": i, "num_gaussians": 100_000 + i} for i in range(0, 900, 100)]
    ((count,),) = [figure.axes for figure in run_curve_figures(log)]
    bottom, top = count.get_ylim()
    assert bottom == 0 and top > 1.03 * 100_800


@pytest.mark.parametrize(("low", "high"), [(0.1, 0.29), (0.002, 0.4), (0.05, 0.06)])
def test_the_loss_has_plain_numbers_on_its_axis(low, high):
    """The loss of a short run used to be labelled 2.75 x 10^-1, 2.5 x 10^-1 and so on."""
    log = [{"iteration": i, "loss": low * (high / low) ** (i / 10)} for i in range(11)]
    (figure,) = run_curve_figures(log)
    FigureCanvasAgg(figure).draw()
    axis, view = figure.axes[0].yaxis, figure.axes[0].get_ylim()
    texts = [
        label.get_text()
        for place, label in zip(axis.get_ticklocs(), axis.get_ticklabels(), strict=True)
        if view[0] <= place <= view[1]
    ]
    assert 1 <= len(texts) <= 8 and all(float(text) > 0 for text in texts), "plain numbers, not powers of ten"
    assert not any(label.get_text() for label in axis.get_ticklabels(minor=True))


@pytest.mark.parametrize("count", [5, 20_000, 6_543_210])
def test_no_label_of_a_curve_is_cut_off(count):
    terms = {"l1": 0.1, "scale": 3e-5}
    line = {"num_gaussians": count, "ms": 1234.5, "psnr": 27.125}
    log = [{"iteration": i, "loss": 0.3 / i, "terms": terms, **line} for i in (1, 100, 30_000)]
    figures = run_curve_figures(log)
    assert len(figures) == 5
    for figure in figures:
        FigureCanvasAgg(figure).draw()
        (axes,), whole = figure.axes, figure.bbox
        shown = axes.get_tightbbox()
        assert whole.x0 <= shown.x0 and shown.x1 <= whole.x1, axes.get_title()
        assert whole.y0 <= shown.y0 and shown.y1 <= whole.y1, axes.get_title()
