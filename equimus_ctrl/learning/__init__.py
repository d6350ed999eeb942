"""Learning: environments of Gymnasium and Stable-Baselines3 for any robot, known to Gymnasium once this is imported."""

from equimus_ctrl.learning.registration import register_environments

register_environments()
