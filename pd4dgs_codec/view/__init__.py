"""Pictures and figures of a file: its levels, camera paths, films, panels, evaluation against a dataset."""
