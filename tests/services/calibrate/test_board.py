"""The printed board: exact on paper, found in pictures, refused where it cannot be."""

import numpy as np
import pypdfium2
import pytest

from penumbra.services.calibrate import board as boards
from penumbra.services.calibrate import sheet
from penumbra.services.calibrate.board import Board, CalibrationError
from penumbra.services.command import cli

DPI = 600


def printed(path, dpi=DPI):
    """The page of a PDF in grey, and millimetres per pixel."""
    (page,) = pypdfium2.PdfDocument(path)
    return np.asarray(page.render(scale=dpi / 72, grayscale=True).to_numpy()).squeeze(), 25.4 / dpi


@pytest.mark.parametrize(
    ("arguments", "size"),
    [
        ([], (280.0, 200.0)),
        (["--squares", "8x11", "--square", "15mm", "--page", "A4"], (120.0, 165.0)),
        (
            ["--squares", "6x4", "--square", "1in", "--marker", "18mm", "--page", "letter", "--dictionary", "5X5_100"],
            (152.4, 101.6),
        ),
    ],
)
def test_the_board_on_paper_has_its_size_to_a_tenth_of_a_millimetre(tmp_path, capsys, arguments, size):
    path = tmp_path / "board.pdf"
    assert cli.main(["calibrate", "board", "-o", str(path), *arguments]) == 0
    assert f"the board is {size[0]:.1f} mm wide and {size[1]:.1f} mm high" in capsys.readouterr().out
    grey, scale = printed(path)
    options = dict(zip(arguments[::2], arguments[1::2], strict=True))
    board = Board(
        boards.squares(options.get("--squares", "7x5")),
        boards.length(options.get("--square", "40mm")),
        boards.length(options["--marker"]) if "--marker" in options else 0.75 * boards.length(options.get("--square", "40mm")),
        options.get("--dictionary", "4X4_100"),
    )
    found = board.find(grey)
    assert found is not None
    corners, numbers = found
    assert len(numbers) == len(board.corners)
    wanted = 1e3 * board.corners[numbers, :2]
    on_paper = corners * scale
    offset = (on_paper - wanted).mean(axis=0)
    assert np.abs(on_paper - wanted - offset).max() < 0.1
    lines = np.sort(np.unique(wanted[:, 0]))
    edges = [on_paper[wanted[:, 0] == line, 0].mean() for line in lines]
    assert np.abs(np.diff(edges) - 1e3 * board.square).max() < 0.05  # a pixel is 0.042 mm


def test_a_board_that_does_not_fit_the_paper_is_refused_with_what_would(tmp_path, capsys):
    path = tmp_path / "board.pdf"
    assert cli.main(["calibrate", "board", "-o", str(path), "--squares", "8x6"]) == 2
    assert "expected at most 287 x 200 mm on A4, got 320 x 240 mm; give a larger --page" in capsys.readouterr().err
    assert not path.exists()
    assert cli.main(["calibrate", "board", "-o", str(path), "--squares", "8x6", "--page", "A3"]) == 0
    assert cli.main(["calibrate", "board", "-o", str(tmp_path / "no" / "board.pdf")]) == 2
    assert "cannot be written" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--square", "40"], "expected a length with its unit, as in 40mm, got '40'"),
        (["--square", "1.2.3mm"], "expected a length with its unit"),
        (["--squares", "7"], "expected columns and rows of squares from 3 to 40, as in 7x5"),
        (["--squares", "2x50"], "expected columns and rows of squares from 3 to 40"),
        (["--marker", "39mm"], "expected 30 % to 95 % of a square of 40 mm, got 39 mm"),
        (["-o", "board.png"], "--out: expected a name that ends with .pdf, got board.png"),
        (["--squares", "20x20", "--square", "8mm", "--page", "A3"], "expected at least 200 markers for this board, got 4X4_100"),
    ],
)
def test_a_board_that_cannot_be_is_refused(tmp_path, capsys, arguments, text):
    assert cli.main(["calibrate", "board", "-o", str(tmp_path / "board.pdf"), *arguments]) == 2
    assert text in capsys.readouterr().err


def test_corners_on_one_line_and_too_few_of_them_are_no_view(tmp_path):
    board = Board((9, 3), 0.02, 0.015)
    sheet.write(board, tmp_path / "board.pdf")
    grey, _ = printed(tmp_path / "board.pdf", 150)
    found = board.find(grey)
    assert found is not None and len(found[1]) == 16
    one_line = grey.copy()
    row = grey.shape[0] // 2
    one_line[row:] = 255  # the lower row of corners, and with it every marker of the last row
    assert board.find(one_line) is None
    assert board.find(np.full_like(grey, 128)) is None


def test_the_measured_square_scales_the_markers_with_it():
    options = sheet.flags.parse([*boards.FLAGS, boards.MEASURED], ["--square", "40mm", "--square-measured", "39.6mm"])
    board = Board.of(options)
    assert board.square == pytest.approx(0.0396) and board.marker == pytest.approx(0.0297)
    with pytest.raises(CalibrationError, match="--marker"):
        Board(marker=0.041)
