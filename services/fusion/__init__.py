"""In: what the senses of the table `shared/contract/senses.py` measure, poses or positions. Out: one pose with velocity and
covariance at 200 Hz.

`observer.py` is the default: an error-state filter (`filter.py`) that knows how limbs move (`motion.py`) and that each sense's
errors last, with a history (`history.py`) for measurements that come late and out of order. `paper.py` is the observer of the
paper (section "Modified Luenberger Observer"), kept as `--observer paper`; it fuses the paper's two senses only. `smoother.py`
makes the trajectory of a recording, from the measurements before and after each moment, with the same filter.
"""
