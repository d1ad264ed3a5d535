"""The modular stack fine-tuned as a whole: planner and controller by MPO on the overall reward, as an agent is.

Estimator and termination are in the loop and stay as they are. This is the paper's future work (section 5), and the
only place where a training run knows more than one module.
"""
