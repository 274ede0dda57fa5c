"""`penumbra calibrate board`: the board as a vector PDF in its exact size."""

from __future__ import annotations

import sys
from pathlib import Path

from reportlab.lib import pagesizes
from reportlab.pdfgen.canvas import Canvas

from penumbra.services import flags
from penumbra.services.calibrate import board as boards
from penumbra.services.calibrate.board import Board, CalibrationError

PAGES = {"A5": pagesizes.A5, "A4": pagesizes.A4, "A3": pagesizes.A3, "A2": pagesizes.A2, "A1": pagesizes.A1, "A0": pagesizes.A0,
         "letter": pagesizes.LETTER, "legal": pagesizes.LEGAL, "tabloid": pagesizes.TABLOID}  # fmt: skip
"""Width and height of portrait pages [pt]."""
POINT = 25.4e-3 / 72
"""A typographic point [m]."""
MARGIN = 5e-3
"""White margin on each side [m]: printers leave this much unprinted, and a marker needs some space around it."""
LETTERS = 6.0
"""Font size of the line of text [pt]."""


@flags.command(
    "calibrate board",
    "Prints a ChArUco board to a PDF in its exact size. Print it at 100 % (not `fit to page`), glue it onto a stiff flat plate, "
    "and measure a whole row of squares: --square-measured of the calibrations takes what the ruler says.",
    flags.Option("-o", "--out", type=Path, default=Path("board.pdf"), metavar="FILE", help="the PDF to write"),
    flags.Option("--page", choices=PAGES, default="A4", help="paper; turned on its side where the board needs it"),
    *boards.FLAGS,
    example="penumbra calibrate board -o board.pdf --squares 7x5 --square 40mm --page A4",
)
def main(options: flags.Options) -> int:
    """Run the command; returns 0, or 2 if the board does not fit or the file cannot be written."""
    try:
        board = Board.of(options)
        write(board, options.out, options.page)
    except CalibrationError as error:
        print(f"penumbra calibrate board: {error}", file=sys.stderr)
        return 2
    width, height = (1e3 * each for each in board.size)
    print(f"{options.out}: {board.squares[0]} x {board.squares[1]} squares of {1e3 * board.square:g} mm on {options.page}")
    print(f"print it at 100 %, and measure: the board is {width:.1f} mm wide and {height:.1f} mm high")
    return 0


def write(board: Board, path: Path, page: str = "A4") -> None:
    """Write the PDF of a board in the middle of a page. Raises CalibrationError if it does not fit, or cannot be written."""
    width, height = board.size
    room = [each - 2.0 * MARGIN / POINT for each in PAGES[page]]
    if path.suffix.lower() != ".pdf":
        raise CalibrationError(f"--out: expected a name that ends with .pdf, got {path}: the board is exact only as a PDF")
    fits = {turn: width <= room[turn] * POINT + 1e-9 and height <= room[1 - turn] * POINT + 1e-9 for turn in (0, 1)}
    if not any(fits.values()):
        larger = f"expected at most {1e3 * max(room) * POINT:.0f} x {1e3 * min(room) * POINT:.0f} mm on {page}"
        raise CalibrationError(
            f"{larger}, got {1e3 * width:g} x {1e3 * height:g} mm; give a larger --page, or fewer or smaller squares"
        )
    paper = PAGES[page] if fits[0] else pagesizes.landscape(PAGES[page])
    try:
        canvas = Canvas(str(path), pagesize=paper)
        canvas.setTitle("Penumbra calibration board")
        canvas.setViewerPreference("PrintScaling", "None")  # the default of print dialogs
        _draw(canvas, board, paper)
        canvas.save()
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be written: {error.strerror}") from None


def _draw(canvas: Canvas, board: Board, paper: tuple[float, float]) -> None:
    """Draw the rectangles as one path, which leaves no hairlines between them, and a line of text along the wider margin."""
    width, height = (each / POINT for each in board.size)
    left, bottom = (paper[0] - width) / 2.0, (paper[1] - height) / 2.0
    path = canvas.beginPath()
    for x, y, w, h in board.black / POINT:
        path.rect(left + x, bottom + height - y - h, w, h)
    canvas.drawPath(path, stroke=0, fill=1)
    whole = f"{1e3 * board.size[0]:.1f} x {1e3 * board.size[1]:.1f} mm"
    text = (
        f"{board.squares[0]}x{board.squares[1]} squares of {1e3 * board.square:g} mm, markers {1e3 * board.marker:g} mm, "
        f"{board.dictionary}. Print at 100 %. The board must measure {whole}; give what a square measures as --square-measured."
    )
    canvas.setFont("Helvetica", LETTERS)
    if left > bottom:
        canvas.translate(left / 2.0 + LETTERS / 3.0, bottom)
        canvas.rotate(90)
        canvas.drawString(0, 0, text)
    else:
        canvas.drawString(left, bottom / 2.0 - LETTERS / 3.0, text)
