-- Definitions that are too large for a column: their canonical text in pieces, each compressed by itself (zstd). Pieces are
-- stored one by one, and belong to no model until all of them are; those that belong to none are removed.
CREATE TABLE definitions (
    id             INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT
) STRICT;

CREATE TABLE definition_pieces (
    definition_id  INTEGER NOT NULL,
    seq            INTEGER NOT NULL, -- from 0
    piece          BLOB    NOT NULL,
    PRIMARY KEY (definition_id, seq)
) STRICT;

-- NULL: `definition` has the text. Else that is empty.
ALTER TABLE models ADD COLUMN definition_id INTEGER;

CREATE INDEX models_by_definition ON models (definition_id) WHERE definition_id IS NOT NULL;
