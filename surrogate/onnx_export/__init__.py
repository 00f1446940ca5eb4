"""Export of trained models as ONNX graphs."""
