"""Sensing boards on serial ports come in, their pads' electrode amplitudes go out, as the emulator would publish them.

`driver.py` is the method: it reads the boards of a pad simultaneously, decodes their sums (`shared.skin.board`), finds each one's
resonance, and recovers boards that lost synchronisation. It sees a port as bytes in, bytes out and a clock; `port.py` is the
real one. `decode.py` reads a single packet by hand.
"""
