"""A web page that shows the cell: in come pictures, masks, joints, voltages, poses and health reports, out go a page and a
websocket for each browser, and the requests of an operator to the emulator and the launcher.

The method is flow control by credit: per stream and page there is one slot, which holds the newest message, and the next one is
sent after the page has shown the last one. So memory is bounded, and what is shown is never old, at every speed of a browser.
"""
