"""What a scene is: tool paths, site, tool, posture, debulking."""
