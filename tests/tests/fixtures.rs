//! Reference files and captures are the ones whose hashes were recorded.

use xtask::{fixtures, tidy};

#[test]
fn references_and_captures_are_as_recorded() {
    let (count, differences) = fixtures::check(tidy::workspace_root()).expect("a readable manifest");
    assert!(count > 0, "nothing was compared");
    let text: Vec<String> = differences.iter().map(ToString::to_string).collect();
    assert!(text.is_empty(), "\n{}", text.join("\n"));
}
