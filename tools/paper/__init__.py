"""The paper's study: every table and figure, as printed and as corrected (`parkctl paper`)."""
