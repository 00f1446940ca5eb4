"""Analysis of accuracy and cost, of errors of the tumour position, and of influences on the tumour's motion."""
