"""The verbs of the command line, a file a topic. Heavy imports happen inside the verbs."""
