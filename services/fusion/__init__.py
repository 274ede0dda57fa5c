"""In: what the senses of the table `shared/contract/senses.py` measure, poses or positions. Out: one pose with velocity and
covariance at 200 Hz.

`observer.py` is the default: an error-state filter (`filter.py`) with a model of limb motion (`motion.py`) and of the lasting
errors of each sense, and with a history (`history.py`) for measurements that come late and out of order. `paper.py` is the
observer of the paper (section "Modified Luenberger-type Observer"), kept as `--observer paper`; it fuses only the paper's two
senses. `smoother.py` computes the trajectory of a recording with the same filter, from the measurements before and after each
moment.
"""
