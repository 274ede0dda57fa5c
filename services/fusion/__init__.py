"""In: the camera's pose with its covariance, the skin's pose with its information. Out: one pose with velocity and
covariance at 200 Hz.

`observer.py` is the default, an error-state filter that knows that each sense's errors last; `paper.py` is the observer of the
paper (section "Modified Luenberger Observer"), kept as `--observer paper`. `history.py` takes measurements late and out of order.
"""
