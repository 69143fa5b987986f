//! Rules about single files: heads, names, panics, printing, machine paths, lengths, lints.

use super::Violations;
use super::source::Source;
use super::tree::{Tree, files_below};
use std::collections::BTreeSet;

/// Names that say nothing about what is inside.
const DRAWERS: &[&str] = &["utils", "util", "common", "types", "helpers", "helper", "manager", "misc"];

/// What stops a program. Written in two halves where this file's own text would otherwise be found.
const PANICS: &[&str] =
    &[".unwrap()", ".expect(", "panic!(", "todo!(", "unimplemented!(", "unreachable!(", ".unwrap_err()"];

/// What prints or exits.
const PRINTS: &[&str] = &["print!(", "println!(", "dbg!(", "process::exit", "process::abort", "stdout()", "stderr()"];

/// Methods of floating-point numbers whose last bits are the platform's.
const PLATFORM_METHODS: &[&str] = &[
    "exp", "exp2", "exp_m1", "ln", "ln_1p", "log", "log2", "log10", "powf", "sin", "cos", "sin_cos", "tan", "asin",
    "acos", "atan", "atan2", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "cbrt", "hypot",
];

/// Functions of glam that call them.
const PLATFORM_ROTATIONS: &[&str] = &[
    "from_rotation_x",
    "from_rotation_y",
    "from_rotation_z",
    "from_axis_angle",
    "from_scaled_axis",
    "from_euler",
    "from_angle",
    "slerp",
    "angle_between",
    "to_axis_angle",
    "to_euler",
];

/// What neither trains nor renders a model: it may draw, print and trace ground truth with the platform's last bits.
const DRAWN: &[&str] = &[
    "crates/diamond-pathtrace/",
    "crates/diamond-synth/",
    "crates/diamond-sss/src/inspect/",
    "crates/diamond-sss/src/report/",
    "crates/diamond-sss/src/export.rs",
];

/// Folders of somebody's machine, in two halves so that this file does not break its own rule.
const MACHINE_PATHS: &[&str] = &[
    concat!("/wo", "rk/"),
    concat!("/t", "mp/"),
    concat!("/ho", "me/"),
    concat!("/ro", "ot/"),
    concat!("/Us", "ers/"),
    concat!("..", "/shared"),
];

/// The floor from which printing is allowed.
const PROGRAM_FLOOR: u8 = 5;

/// Lines from which a file is worth a second look.
const LONG: usize = 600;

fn at(source: &Source, line: usize, message: impl Into<String>) -> (String, usize, String) {
    (source.path.clone(), line, message.into())
}

/// Rust that ships in a library or in the tools: no tests, no testkit.
fn shipped(tree: &Tree) -> impl Iterator<Item = &Source> {
    tree.rust().filter(|source| {
        let ours = source.path.starts_with("crates/") || source.path.starts_with("xtask/src/");
        ours && !source.path.starts_with("crates/diamond-testkit/")
    })
}

/// Every manifest inherits the lints, the workspace asks for documentation, and no file waives it.
pub fn workspace_lints(tree: &Tree) -> Violations {
    let mut found = Vec::new();
    let ours = |source: &&Source| {
        let (folder, file) = source.path.rsplit_once('/').unwrap_or(("", &source.path));
        file == "Cargo.toml" && (["", "xtask", "tests"].contains(&folder) || folder.starts_with("crates/"))
    };
    for source in tree.sources.iter().filter(ours) {
        let lines: Vec<&str> = source.text.lines().map(str::trim).filter(|line| !line.is_empty()).collect();
        if source.path == "Cargo.toml" {
            let asked = lines.iter().any(|line| line.starts_with("missing_docs") && !line.contains("allow"));
            if !asked {
                found.push(at(source, 0, "[workspace.lints.rust] must set missing_docs to warn or deny"));
            }
        } else if !lines.windows(2).any(|pair| pair == ["[lints]", "workspace = true"]) {
            found.push(at(source, 0, "add `[lints]` with `workspace = true`"));
        }
    }
    for source in tree.rust() {
        for (line, code) in source.shipped_code() {
            let waived = code.contains("missing_docs") && (code.contains("allow") || code.contains("expect"));
            if waived {
                found.push(at(source, line, "document the item instead of waiving missing_docs"));
            }
        }
    }
    Ok(found)
}

/// The first line of every Rust file is `//!`.
pub fn file_head(tree: &Tree) -> Violations {
    let bare = tree.rust().filter(|source| {
        let head = source.text.lines().next().unwrap_or_default();
        head.strip_prefix("//!").is_none_or(|rest| rest.trim().is_empty())
    });
    Ok(bare.map(|source| at(source, 1, "begin the file with `//!` and the concept that it holds")).collect())
}

/// No file, folder or module is a drawer for leftovers.
pub fn file_name(tree: &Tree) -> Violations {
    let mut found = Vec::new();
    for source in tree.rust() {
        let parts = source.path.trim_end_matches(".rs").split('/');
        for part in parts.filter(|part| DRAWERS.contains(part)) {
            found.push(at(source, 0, format!("`{part}` names no concept: name the file after what it holds")));
        }
        for (i, line) in source.code.lines().enumerate() {
            let inline = line.trim().trim_start_matches("pub ").strip_prefix("mod ");
            let name = inline.map(|rest| rest.trim_end_matches(['{', '}', ';', ' ']));
            if let Some(name) = name.filter(|name| DRAWERS.contains(name)) {
                found.push(at(source, i + 1, format!("`mod {name}` names no concept")));
            }
        }
    }
    Ok(found)
}

/// Shipped code returns errors.
pub fn no_panic(tree: &Tree) -> Violations {
    let mut found = Vec::new();
    for source in shipped(tree) {
        for (line, code) in source.shipped_code() {
            if let Some(what) = PANICS.iter().find(|what| code.contains(**what)) {
                found.push(at(source, line, format!("`{what}` in shipped code: return the crate's error instead")));
            }
        }
    }
    Ok(found)
}

/// Below the program nothing prints or exits.
pub fn no_print(tree: &Tree) -> Violations {
    let mut found = Vec::new();
    let below = |source: &&Source| {
        source.path.starts_with("crates/") && tree.floor_of(&source.path).is_none_or(|floor| floor < PROGRAM_FLOOR)
    };
    for source in tree.rust().filter(below) {
        for (line, code) in source.shipped_code() {
            if let Some(what) = PRINTS.iter().find(|what| code.contains(**what)) {
                found.push(at(source, line, format!("`{what}` below floor {PROGRAM_FLOOR}: return a value instead")));
            }
        }
    }
    Ok(found)
}

/// Whether a line of code calls a method, or names a function of a number or vector, whose last bits are the platform's.
fn platform_call(code: &str) -> Option<&'static str> {
    let called = |name: &&&str| {
        let method = code.contains(&format!(".{name}("));
        let path = code.match_indices(&format!("::{name}")).any(|(start, found)| {
            let whole = !code[start + found.len()..].starts_with(|c: char| c.is_alphanumeric() || c == '_');
            let owner = code[..start].rsplit(|c: char| !c.is_alphanumeric()).next().unwrap_or_default();
            whole && (matches!(owner, "f32" | "f64" | "Vec2" | "Vec3" | "Vec3A" | "Vec4" | "DVec2" | "DVec3" | "DVec4"))
        });
        method || path
    };
    let rotation = |name: &&&str| ["::", "."].iter().any(|before| code.contains(&format!("{before}{name}(")));
    PLATFORM_METHODS.iter().find(called).or_else(|| PLATFORM_ROTATIONS.iter().find(rotation)).copied()
}

/// What trains or renders takes elementary functions from `libm` or `diamond-simd`.
pub fn same_bits(tree: &Tree) -> Violations {
    let mut found = Vec::new();
    let ours = |source: &&Source| {
        source.path.starts_with("crates/") && !DRAWN.iter().any(|folder| source.path.starts_with(folder))
    };
    for source in shipped(tree).filter(ours) {
        for (line, code) in source.shipped_code() {
            if let Some(what) = platform_call(code) {
                found.push(at(source, line, format!("`{what}` has the platform's last bits: use libm's")));
            }
        }
    }
    Ok(found)
}

/// No text names a folder of somebody's machine.
pub fn stands_alone(tree: &Tree) -> Violations {
    let mut found = Vec::new();
    for source in &tree.sources {
        for (i, line) in source.text.lines().enumerate() {
            for pattern in MACHINE_PATHS {
                // `target/work/` inside a longer relative path is nobody's machine.
                let absolute = line.match_indices(pattern).any(|(start, _)| {
                    let before = line[..start].chars().next_back();
                    pattern.starts_with('.') || !before.is_some_and(|c| c.is_alphanumeric() || "_-.}".contains(c))
                });
                if absolute {
                    found.push(at(source, i + 1, format!("`{pattern}` is not part of the repository")));
                }
            }
        }
    }
    Ok(found)
}

/// Each folder of references has a README that states its origin.
pub fn fixture_readme(tree: &Tree) -> Violations {
    let files: BTreeSet<String> = files_below(&tree.root)?.into_iter().collect();
    let mut folders = BTreeSet::new();
    for path in &files {
        let mut parts = path.splitn(4, '/');
        let (top, kind, name, rest) = (parts.next(), parts.next(), parts.next(), parts.next());
        if let (Some("assets"), Some(kind @ ("fixtures" | "captures")), Some(name), Some(_)) = (top, kind, name, rest) {
            folders.insert(format!("assets/{kind}/{name}"));
        }
    }
    let bare = folders.into_iter().filter(|folder| !files.contains(&format!("{folder}/README.md")));
    Ok(bare.map(|folder| (folder, 0, "add a README.md that states origin, generator and version".into())).collect())
}

/// A permission gives its reason.
pub fn allow_reason(tree: &Tree) -> Violations {
    let mut found = Vec::new();
    for source in tree.rust() {
        for allow in source.allows.iter().filter(|allow| allow.reason.is_empty()) {
            found.push(at(source, allow.written_at, "a permission without a reason lifts nothing"));
        }
    }
    Ok(found)
}

/// A long file is worth a second look.
pub fn file_length(tree: &Tree) -> Violations {
    let long = tree.rust().map(|source| (source, source.text.lines().count())).filter(|(_, lines)| *lines > LONG);
    Ok(long.map(|(source, lines)| at(source, 0, format!("{lines} lines: look for a second concept"))).collect())
}
