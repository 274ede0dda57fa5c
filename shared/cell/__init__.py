"""One description of the cell, and the cells that come with Penumbra in `built_in/`."""
