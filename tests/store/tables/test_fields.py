"""Flow fields and images for other libraries: xarray, Zarr, Matplotlib."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import flowrec
from flowrec.core import UsageError, fluid_of

GOLDEN = Path(__file__).parents[3] / "sessions" / "golden.mcap"


def test_a_field_is_a_dataset_with_places_in_um_units_and_error() -> None:
    session = flowrec.open(GOLDEN)
    field = session.fields["refined"]
    data = field.to_xarray()
    assert dict(data.sizes) == {"y_um": 256, "x_um": 320, "component": 2}
    assert np.array_equal(data.velocity_um_s.values, field.velocity_um_s)
    assert np.array_equal(data.std_um_s.values, field.std_um_s)
    one = data.velocity_um_s.sel(x_um=400.0, y_um=2700.0, component="x")
    assert float(one) == field.velocity_um_s[135, 20, 0]
    assert data.velocity_um_s.attrs["units"] == "um/s" and "pixel centres" in data.velocity_um_s.attrs["description"]
    assert data.attrs["method"] == field.method and data.x_um.attrs["units"] == "um"
    assert "std_um_s" not in replace(field, std_um_s=None).to_xarray()
    frame = field.to_pandas()
    assert len(frame) == session.chip.mask.sum()
    at = frame[(frame.x_um == 400.0) & (frame.y_um == 2700.0)]
    assert float(at.u_um_s.iloc[0]) == field.velocity_um_s[135, 20, 0]


def test_a_field_and_its_error_are_drawn_without_the_true_flow() -> None:
    import matplotlib as mpl

    mpl.use("agg")
    import matplotlib.pyplot as plt
    from matplotlib.quiver import Quiver

    session = flowrec.open(GOLDEN)
    field = session.fields["refined"]
    assert np.array_equal(fluid_of(field), session.chip.mask)
    path_um = np.array([[400.0, 2700.0], [800.0, 2700.0]])
    for show in ("speed", "error"):
        axes = field.plot(show=show, path_um=path_um)
        image = axes.images[0]
        vectors = field.velocity_um_s if show == "speed" else field.std_um_s
        assert vectors is not None
        drawn = np.ma.filled(np.ma.masked_invalid(image.get_array()), 0.0)
        assert np.allclose(drawn, np.where(session.chip.mask, np.hypot(*np.moveaxis(vectors, -1, 0)), 0.0))
        arrows = [each for each in axes.collections if isinstance(each, Quiver)]
        assert len(arrows) == (show == "speed")
        for each in arrows:
            columns, rows = np.rint(each.get_offsets() / field.um_per_px).astype(int).T
            assert session.chip.mask[rows, columns].all()
            assert np.array_equal(np.column_stack([each.U, each.V]), field.velocity_um_s[rows, columns])
        assert axes.yaxis_inverted() and axes.lines[0].get_xydata().tolist() == path_um.tolist()
        axes.figure.canvas.draw()
        plt.close(axes.figure)
    with pytest.raises(UsageError, match="states no error"):
        replace(field, std_um_s=None).plot(show="error")
    with pytest.raises(UsageError, match=r"shape \(3,\); it must be \(n, 2\)"):
        field.plot(path_um=[1, 2, 3])
    plt.close("all")


def test_a_field_that_is_low_and_wide_has_arrows_and_a_bar_that_can_be_read() -> None:
    import matplotlib as mpl

    mpl.use("agg")
    import matplotlib.pyplot as plt
    from matplotlib.quiver import Quiver

    mask = np.zeros((12, 900), np.bool_)
    mask[3:9] = True
    axes = flowrec.solve(mask, um_per_px=2.0).plot()
    arrows = next(each for each in axes.get_children() if isinstance(each, Quiver))
    axes.figure.canvas.draw()
    bar = axes.images[0].colorbar
    assert arrows.N >= 20 and bar is not None
    assert bar.ax.get_position().width > 0.8, "along the picture, not as high as it is"
    plt.close(axes.figure)


def test_any_image_is_read_by_its_number_and_a_loop_reads_all_of_them() -> None:
    frames = flowrec.open(GOLDEN).frames
    every = list(frames)
    assert len(frames) == len(every) == 107
    for number in (0, 50, -1):
        assert frames[number].same_as(every[number])
    assert [frame.index for frame in frames[10:16:2]] == [every[number].index for number in (10, 12, 14)]
    assert frames[::-1][0].same_as(every[-1])
    assert frames.stamps_ns.tolist() == [frame.stamp_ns for frame in every]
    assert np.isnat(frames.wall_times).all()  # this file does not state when its clock was 0
    with pytest.raises(IndexError, match="frame 107 of 107"):
        frames[107]


def test_xarray_reads_images_fields_and_stamps_back_from_zarr(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import xarray

    from flowrec.stages import load_config
    from tests.short_missions import SMALL

    path = flowrec.record(load_config(None, [*SMALL, "duration_s=0.3"]), tmp_path / "a.mcap").path
    session = flowrec.open(path)
    every = list(session.frames)
    assert len(every) % 4
    monkeypatch.setattr("flowrec.exports.zarr._CHUNK_BYTES", 4 * every[0].image.nbytes)  # the last chunk is not full
    folder = flowrec.export(session, file_format="zarr")
    data = xarray.open_zarr(folder)
    assert np.array_equal(data.frames.values, np.stack([frame.image for frame in every]))
    assert data.frames.dtype == np.uint8
    assert data.frame_index.values.tolist() == [frame.index for frame in every]
    stamps = [frame.stamp_ns for frame in every]
    assert data.stamp_ns.values.tolist() == stamps
    start = session.header.start_unix_ns
    assert np.array_equal(data.time.values, session.frames.wall_times)
    assert data.time.values.astype(np.int64).tolist() == [start + stamp for stamp in stamps]
    for name, field in session.fields.items():
        assert np.array_equal(xarray.open_zarr(folder, group=name).velocity_um_s.values, field.velocity_um_s)
