"""Definition of scenes: tool paths, site, tool, posture, debulking."""
