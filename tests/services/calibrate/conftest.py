import pytest

from penumbra.services.calibrate.board import Board
from penumbra.tests.support.charuco import Photographer


@pytest.fixture(scope="session")
def photographer():
    """A camera with distortion that takes pictures of the default board."""
    return Photographer(Board())
