"""`penumbra up`: starts the processes of a cell, watches them, starts them again and shows how they are."""
