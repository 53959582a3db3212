"""Commands that say what there is: terms, methods, keys of files, examples, completion."""
