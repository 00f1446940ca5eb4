"""Definition of scenes: tool, tool paths, craniotomy, camera, head pose, resection and error models."""
