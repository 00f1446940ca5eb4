"""The learners and the test of the paper of 2017, reproduced."""
