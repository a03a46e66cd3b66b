"""What the service answers to, a file a subject; `server.app` has the list."""
