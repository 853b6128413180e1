"""From a web server to the first picture: a range server with a paced link, a client that resumes, packages."""
