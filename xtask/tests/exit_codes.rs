//! The promise of `cargo xtask` to scripts: 0 all is well, 1 a check failed, 2 wrong usage or unreadable input.

use std::fs;
use std::process::Command;

fn exit_code(arguments: &[&str]) -> (Option<i32>, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_xtask")).args(arguments).output().expect("the program starts");
    let text = [output.stdout, output.stderr].concat();
    (output.status.code(), String::from_utf8_lossy(&text).into_owned())
}

#[test]
fn rules_and_help_succeed() {
    assert_eq!(exit_code(&["tidy", "--rules"]).0, Some(0));
    let (code, text) = exit_code(&["--help"]);
    assert_eq!(code, Some(0));
    assert!(text.contains("Examples:") && text.contains("Exit codes:"), "{text}");
}

#[test]
fn an_oracle_that_agrees_gives_0_and_one_that_does_not_gives_1() {
    let table = xtask::tidy::workspace_root().join("assets/fixtures/ggx/ggx.csv");
    let (code, text) = exit_code(&["oracle", "ggx", &table.to_string_lossy()]);
    assert_eq!(code, Some(0), "{text}");

    let broken = std::env::temp_dir().join(format!("diamond-exit-codes-{}.csv", std::process::id()));
    let rows = fs::read_to_string(&table).expect("the table");
    let mut lines: Vec<String> = rows.lines().take(3).map(str::to_string).collect();
    let column = lines[0].split(',').position(|name| name == "D_ggx").expect("the column");
    let mut cells: Vec<String> = lines[2].split(',').map(str::to_string).collect();
    cells[column].insert(0, '9');
    lines[2] = cells.join(",");
    fs::write(&broken, lines.join("\n")).expect("written");
    let (code, text) = exit_code(&["oracle", "ggx", &broken.to_string_lossy()]);
    let _ = fs::remove_file(&broken);
    assert_eq!(code, Some(1), "{text}");
    assert!(text.contains("FAIL"), "{text}");
}

#[test]
fn wrong_usage_and_a_missing_file_give_2() {
    for arguments in [&["oracle", "colour", "x"][..], &["polish"], &[], &["oracle", "ggx", "no/such/table.csv"]] {
        let (code, text) = exit_code(arguments);
        assert_eq!(code, Some(2), "{arguments:?}: {text}");
    }
}
