"""The cell file: its model, its validation, and the cells that come with Penumbra in `built_in/`."""
