//! The house rules hold; `cargo xtask tidy --rules` says what they are and why.

use xtask::tidy;

#[test]
fn the_tree_obeys_the_house_rules() {
    let findings = tidy::run(tidy::workspace_root()).expect("a readable tree");
    let errors: Vec<String> = findings.iter().filter(|finding| !finding.warning).map(ToString::to_string).collect();
    assert!(errors.is_empty(), "\n{}", errors.join("\n"));
}
