"""One thin router per resource: validate, call one function, shape the answer."""
