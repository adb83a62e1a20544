"""The documents as a site: what its pages are made from, beside the documents themselves."""
