//! Tables as CSV, of any text: what is accepted is a table that a tube can have, and written again it reads back the same.

#![no_main]

use benderd::config::{Document, Table, format_table, parse_table};
use libfuzzer_sys::fuzz_target;

fn parse(text: &str) -> Option<Table> {
    match parse_table(&Document::new("table.csv", text)) {
        Ok(table) => Some(table),
        Err(error) => {
            assert!(error.to_string().starts_with("table.csv"), "{error}");
            None
        }
    }
}

fuzz_target!(|text: &str| {
    let Some(table) = parse(text) else { return };
    if let Table::Lra(lra) = &table {
        lra.validate().unwrap_or_else(|error| panic!("accepted, but {error}"));
    }
    let written = format_table(&table);
    let again = parse(&written).unwrap_or_else(|| panic!("what was written is refused:\n{written}"));
    assert_eq!(format_table(&again), written);
});
