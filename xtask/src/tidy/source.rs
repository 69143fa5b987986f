//! One source file, taken apart just far enough to be judged line by line.
//!
//! A rule that looks for `panic` must not stumble over the word in a comment, in a string, or in a test. So a Rust file
//! is kept as three texts of equal shape: as written, its code with comments and literals blanked, and its comments with
//! everything else blanked; and each line knows whether it belongs to test code.

use std::cell::Cell;

/// A comment that lifts a line rule for its own line, or for the next line when it stands alone: the marker, then the
/// reason, then a closing parenthesis.
pub const ALLOW: &str = "tidy: allow(";

/// A permission found in a comment.
#[derive(Debug)]
pub struct Allow {
    /// Line of the comment, from 1.
    pub written_at: usize,
    /// Line that it lifts rules for, from 1.
    pub line: usize,
    /// Why.
    pub reason: String,
    /// Whether a finding was lifted by it.
    pub used: Cell<bool>,
}

/// A text file of the tree.
#[derive(Debug)]
pub struct Source {
    /// Path from the root, with forward slashes.
    pub path: String,
    /// As written.
    pub text: String,
    /// Code alone; equal to `text` for what is not Rust.
    pub code: String,
    /// Comments alone; empty for what is not Rust.
    pub comments: String,
    /// Per line (from 0): whether it is test code.
    pub test_lines: Vec<bool>,
    /// Permissions, Rust only.
    pub allows: Vec<Allow>,
}

impl Source {
    /// Takes `text` apart.
    pub fn new(path: impl Into<String>, text: impl Into<String>) -> Self {
        let (path, text) = (path.into(), text.into());
        let lines = text.lines().count();
        if !path.ends_with(".rs") {
            let code = text.clone();
            return Source {
                path,
                text,
                code,
                comments: String::new(),
                test_lines: vec![false; lines],
                allows: vec![],
            };
        }
        let (code, comments) = separate(&text);
        let all = path.split('/').any(|part| matches!(part, "tests" | "benches" | "examples"));
        let test_lines = if all { vec![true; lines] } else { lines_under_cfg_test(&code, lines) };
        let allows = find_allows(&code, &comments);
        Source { path, text, code, comments, test_lines, allows }
    }

    /// Whether this is Rust.
    pub fn is_rust(&self) -> bool {
        self.path.ends_with(".rs")
    }

    /// Lines of code with their number from 1, tests left out.
    pub fn shipped_code(&self) -> impl Iterator<Item = (usize, &str)> {
        self.code.lines().enumerate().filter(|(i, _)| !self.test_lines[*i]).map(|(i, line)| (i + 1, line))
    }

    /// Lines as written that are test code.
    pub fn test_text(&self) -> impl Iterator<Item = &str> {
        self.text.lines().zip(&self.test_lines).filter(|(_, test)| **test).map(|(line, _)| line)
    }

    /// The permission for `line` (from 1), if any.
    pub fn allow_at(&self, line: usize) -> Option<&Allow> {
        self.allows.iter().find(|allow| allow.line == line)
    }
}

/// Splits Rust into (code, comments), each with the line structure of `text`; literals are blank in both.
fn separate(text: &str) -> (String, String) {
    #[derive(PartialEq)]
    enum State {
        Code,
        Line,
        Block(usize),
        Text,
        Raw(usize),
    }
    let chars: Vec<char> = text.chars().collect();
    let (mut code, mut comments) = (String::with_capacity(text.len()), String::with_capacity(text.len()));
    let mut state = State::Code;
    let mut i = 0;
    // Emits `n` characters to the text that they belong to, and blanks to the other; newlines go to both.
    let emit = |n: usize, i: &mut usize, to_code: bool, to_comments: bool, code: &mut String, comments: &mut String| {
        for &c in &chars[*i..(*i + n).min(chars.len())] {
            let blank = if c == '\n' { '\n' } else { ' ' };
            code.push(if to_code { c } else { blank });
            comments.push(if to_comments { c } else { blank });
        }
        *i += n;
    };
    while i < chars.len() {
        let c = chars[i];
        let next = chars.get(i + 1).copied();
        match state {
            State::Code => {
                let before = i.checked_sub(1).map(|j| chars[j]);
                let in_word = before.is_some_and(|b| b.is_alphanumeric() || b == '_');
                if c == '/' && next == Some('/') {
                    state = State::Line;
                    emit(2, &mut i, false, true, &mut code, &mut comments);
                } else if c == '/' && next == Some('*') {
                    state = State::Block(1);
                    emit(2, &mut i, false, true, &mut code, &mut comments);
                } else if let (false, Some((length, hashes))) = (in_word, raw_opening(&chars[i..])) {
                    state = State::Raw(hashes);
                    emit(length, &mut i, true, false, &mut code, &mut comments);
                } else if c == '"' {
                    state = State::Text;
                    emit(1, &mut i, true, false, &mut code, &mut comments);
                } else if c == '\'' {
                    let literal = match (next, chars.get(i + 2)) {
                        (Some('\\'), _) => {
                            // From two past the backslash, so that '\'' ends at its third quote.
                            chars[(i + 3).min(chars.len())..].iter().position(|&c| c == '\'').map(|at| at + 4)
                        }
                        (Some(_), Some('\'')) => Some(3),
                        _ => None,
                    };
                    emit(literal.unwrap_or(1), &mut i, literal.is_none(), false, &mut code, &mut comments);
                } else {
                    emit(1, &mut i, true, false, &mut code, &mut comments);
                }
            }
            State::Line => {
                if c == '\n' {
                    state = State::Code;
                }
                emit(1, &mut i, false, true, &mut code, &mut comments);
            }
            State::Block(depth) => {
                let (length, depth) = match (c, next) {
                    ('*', Some('/')) => (2, depth - 1),
                    ('/', Some('*')) => (2, depth + 1),
                    _ => (1, depth),
                };
                state = if depth == 0 { State::Code } else { State::Block(depth) };
                emit(length, &mut i, false, true, &mut code, &mut comments);
            }
            State::Text => match c {
                '\\' => emit(2, &mut i, false, false, &mut code, &mut comments),
                '"' => {
                    state = State::Code;
                    emit(1, &mut i, true, false, &mut code, &mut comments);
                }
                _ => emit(1, &mut i, false, false, &mut code, &mut comments),
            },
            State::Raw(hashes) => {
                let closes = c == '"' && (1..=hashes).all(|k| chars.get(i + k) == Some(&'#'));
                if closes {
                    state = State::Code;
                    emit(1 + hashes, &mut i, true, false, &mut code, &mut comments);
                } else {
                    emit(1, &mut i, false, false, &mut code, &mut comments);
                }
            }
        }
    }
    (code, comments)
}

/// The length of a raw string's opening (`r"`, `r#"`, `br##"`, …) at the start of `chars` and its number of `#`.
fn raw_opening(chars: &[char]) -> Option<(usize, usize)> {
    let prefix = match chars {
        ['r', ..] => 1,
        ['b' | 'c', 'r', ..] => 2,
        _ => return None,
    };
    let hashes = chars[prefix..].iter().take_while(|&&c| c == '#').count();
    (chars.get(prefix + hashes) == Some(&'"')).then_some((prefix + hashes + 1, hashes))
}

/// Which lines lie under `#[cfg(test)]` or `#[test]`, from the attribute to the end of the item.
fn lines_under_cfg_test(code: &str, lines: usize) -> Vec<bool> {
    let bytes = code.as_bytes();
    let mut marked = vec![false; lines];
    let line_of = |at: usize| bytes[..at].iter().filter(|&&b| b == b'\n').count();
    for attribute in ["#[cfg(test)]", "#[cfg(any(test", "#[cfg(all(test", "#[test]"] {
        for (start, _) in code.match_indices(attribute) {
            let (mut depth, mut end) = (0usize, bytes.len());
            // Past the attribute itself; brackets of further attributes and of parameter lists hold no braces.
            for (at, &b) in bytes.iter().enumerate().skip(start + attribute.len()) {
                match b {
                    b'{' => depth += 1,
                    b'}' => depth = depth.saturating_sub(1),
                    _ => {}
                }
                if depth == 0 && (b == b'}' || b == b';') {
                    end = at;
                    break;
                }
            }
            let last = line_of(end).min(lines.saturating_sub(1));
            for line in &mut marked[line_of(start)..=last] {
                *line = true;
            }
        }
    }
    marked
}

fn find_allows(code: &str, comments: &str) -> Vec<Allow> {
    let code: Vec<&str> = code.lines().collect();
    let mut found = Vec::new();
    for (i, comment) in comments.lines().enumerate() {
        let Some(at) = comment.find(ALLOW) else { continue };
        let rest = &comment[at + ALLOW.len()..];
        let reason = rest.rfind(')').map_or("", |end| &rest[..end]).trim().to_string();
        let alone = code.get(i).is_none_or(|line| line.trim().is_empty());
        let line = if alone { i + 2 } else { i + 1 };
        found.push(Allow { written_at: i + 1, line, reason, used: Cell::new(false) });
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    fn code(text: &str) -> String {
        Source::new("a.rs", text).code
    }

    #[test]
    fn comments_and_literals_are_blank_in_code() {
        assert_eq!(code("a // b\nc"), "a     \nc");
        assert_eq!(code("a /* b /* c */ d */ e"), "a                   e");
        assert_eq!(code(r#"f("x\"y")"#), r#"f("    ")"#);
        assert_eq!(code(r##"f(r#"x"y"#)"##), r##"f(r#"   "#)"##);
        assert_eq!(code(r#"for"x""#), r#"for" ""#);
        assert_eq!(code("'\"' 'a '\\'' b"), "    'a      b");
        assert_eq!(code("&'static str"), "&'static str");
    }

    #[test]
    fn comments_survive_in_comments_only_and_lines_keep_their_number() {
        let source = Source::new("a.rs", "//! head\nlet s = \"// no\"; // yes\n/* two\nlines */ x");
        assert_eq!(source.comments.lines().count(), 4);
        assert_eq!(source.comments.lines().nth(1).map(str::trim), Some("// yes"));
        assert_eq!(source.code.lines().nth(3).map(str::trim), Some("x"));
    }

    #[test]
    fn test_code_is_from_the_attribute_to_the_closing_brace() {
        let text =
            "fn a() {}\n#[cfg(test)]\nmod tests {\n  fn b() { c(); }\n}\nfn d() {}\n#[cfg(test)]\nmod far;\nfn e() {}";
        let source = Source::new("src/a.rs", text);
        assert_eq!(source.test_lines, [false, true, true, true, true, false, true, true, false]);
        assert!(Source::new("tests/a.rs", "fn a() {}").test_lines[0]);
        let braces = Source::new("src/a.rs", "#[test]\nfn a() {\n  let s = \"}\"; // }\n  b()\n}\nfn c() {}");
        assert_eq!(braces.test_lines, [true, true, true, true, true, false]);
    }

    #[test]
    fn an_allow_covers_its_line_or_the_next_when_alone() {
        let marker = ALLOW;
        let text = format!("a(); // {marker}checked (above))\n// {marker}why)\nb();\nlet s = \"// {marker}no)\";");
        let source = Source::new("src/a.rs", text);
        assert_eq!(source.allow_at(1).map(|a| a.reason.as_str()), Some("checked (above)"));
        assert_eq!(source.allow_at(3).map(|a| a.reason.as_str()), Some("why"));
        assert_eq!(source.allows.len(), 2);
    }
}
