"""A web page that shows the cell: in come pictures, masks, joints, voltages, poses and health reports, out go a page and a
websocket for each browser, and the requests of an operator to the emulator and the launcher.

The method is flow control by credit: each stream of each page has one slot, which holds the newest message, and the next message
is sent after the page has shown the last one. So memory is bounded, and the page never shows old data, at any browser's speed.
"""
