//! From good files to bad ones: mutations that know a little of how files are made.
//!
//! Flipped bits alone seldom get past a header. So numbers become extremes where they stand, in text as in binary; blocks
//! are cut, doubled and exchanged between two files of a kind; and half of the changes to binary files go to their first
//! bytes, where counts and offsets are.
use super::random::Random;

/// Files do not grow by more than this.
const GROWTH: usize = 64 << 10;

/// Bytes that count as the start of a binary file.
const HEADER: usize = 128;

const WORDS: &[&str] = &[
    "0",
    "-0",
    "1",
    "-1",
    "2",
    "255",
    "256",
    "65536",
    "1e-46",
    "1e-30",
    "1e20",
    "1e38",
    "3.5e38",
    "-3.5e38",
    "1e308",
    "1e999",
    "nan",
    "NaN",
    "inf",
    "-inf",
    "Infinity",
    "null",
    "true",
    "\"\"",
    "\"..\"",
    "\"../../x\"",
    "\"\\ud800\"",
    "\"é\u{0301}\"",
    "{}",
    "[]",
    "[[]]",
    "2147483647",
    "2147483648",
    "4294967295",
    "4294967296",
    "9223372036854775807",
    "18446744073709551615",
    "18446744073709551616",
    "-9223372036854775809",
    "99999999999999999999999999999999999999999999999999",
    "0.00000000000000000000000000000000000000000000000001",
    "",
    "\u{feff}",
    "\u{0}",
    "\u{202e}",
];

/// Changes `input` once or a few times. `other` is another good file of the kind.
pub fn mutate(random: &mut Random, input: &mut Vec<u8>, other: &[u8], text: bool) {
    let longest = input.len() + GROWTH;
    loop {
        if text && !random.one_in(8) {
            change_text(random, input, other)
        } else {
            change_bytes(random, input, other)
        }
        input.truncate(longest);
        if random.one_in(2) {
            return;
        }
    }
}

fn place(random: &mut Random, length: usize) -> usize {
    if random.one_in(2) { random.below(length.min(HEADER)) } else { random.below(length) }
}

fn block(random: &mut Random, length: usize) -> std::ops::Range<usize> {
    let start = place(random, length);
    let longest = [1, 4, 16, 256, 4096][random.below(5)];
    start..(start + 1 + random.below(longest)).min(length)
}

fn overwrite(input: &mut [u8], at: usize, bytes: &[u8]) {
    for (to, from) in input.iter_mut().skip(at).zip(bytes) {
        *to = *from;
    }
}

fn extreme_integer(random: &mut Random) -> u64 {
    let bits = random.below(64) as u32;
    let power = 1u64 << bits;
    *random.pick(&[0, 1, power, power.wrapping_sub(1), power.wrapping_neg(), u64::MAX, u64::MAX - u64::from(bits)])
}

const EXTREME_FLOATS: &[f32] = &[
    f32::NAN,
    f32::INFINITY,
    f32::NEG_INFINITY,
    f32::MAX,
    f32::MIN,
    f32::MIN_POSITIVE,
    1e-45,
    -0.0,
    1e20,
    -1e20,
    1e-20,
    88.8,
    -104.0,
];

fn change_bytes(random: &mut Random, input: &mut Vec<u8>, other: &[u8]) {
    if input.is_empty() {
        input.extend_from_slice(&other[..random.below(other.len() + 1)]);
        return;
    }
    let at = place(random, input.len());
    match random.below(12) {
        0 => input[at] ^= 1 << random.below(8),
        1 => input[at] = *random.pick(&[0, 1, 0x7f, 0x80, 0xff, b'\n', b' ', b'"', b'-']),
        2 | 3 => {
            let value = extreme_integer(random);
            let width = *random.pick(&[2, 4, 4, 8]);
            let at = if random.one_in(2) { at / width * width } else { at };
            match random.one_in(4) {
                true => overwrite(input, at, &value.to_be_bytes()[8 - width..]),
                false => overwrite(input, at, &value.to_le_bytes()[..width]),
            }
        }
        4 => {
            let float = random.pick(EXTREME_FLOATS).to_le_bytes();
            overwrite(input, at / 4 * 4, &float);
        }
        5 => {
            let small = random.below(33) as i8 - 16;
            input[at] = input[at].wrapping_add_signed(small);
        }
        6 => input.truncate(at),
        7 => drop(input.drain(block(random, input.len()))),
        8 => {
            let copy = input[block(random, input.len())].to_vec();
            let at = random.below(input.len() + 1);
            input.splice(at..at, copy);
        }
        9 => {
            let noise: Vec<u8> = (0..=random.below(16)).map(|_| random.next() as u8).collect();
            input.splice(at..at, noise);
        }
        10 if !other.is_empty() => {
            let from = other[block(random, other.len())].to_vec();
            overwrite(input, at, &from);
        }
        _ => {
            let from = if random.one_in(2) { at } else { random.below(other.len() + 1) };
            input.truncate(at);
            input.extend_from_slice(other.get(from..).unwrap_or_default());
        }
    }
}

/// Numbers, words and quoted strings.
fn tokens(text: &[u8]) -> Vec<std::ops::Range<usize>> {
    let mut out = Vec::new();
    let mut i = 0;
    while i < text.len() {
        let start = i;
        if text[i] == b'"' {
            i += 1;
            while i < text.len() && text[i] != b'"' {
                i += 1;
            }
            i = (i + 1).min(text.len());
        } else {
            while i < text.len() && (text[i].is_ascii_alphanumeric() || b"+-._".contains(&text[i])) {
                i += 1;
            }
        }
        if i > start { out.push(start..i) } else { i += 1 }
    }
    out
}

fn lines(text: &[u8]) -> Vec<std::ops::Range<usize>> {
    let mut start = 0;
    text.split_inclusive(|b| *b == b'\n')
        .map(|line| {
            start += line.len();
            start - line.len()..start
        })
        .collect()
}

fn change_text(random: &mut Random, input: &mut Vec<u8>, other: &[u8]) {
    let found = tokens(input);
    if found.is_empty() {
        return change_bytes(random, input, other);
    }
    let token = random.pick(&found).clone();
    match random.below(10) {
        0..=3 => {
            let word = random.pick(WORDS).as_bytes().to_vec();
            input.splice(token, word);
        }
        4 => {
            let from = tokens(other);
            if !from.is_empty() {
                input.splice(token, other[random.pick(&from).clone()].to_vec());
            }
        }
        5 => {
            let another = random.pick(&found).clone();
            let (a, b) = if token.start < another.start { (token, another) } else { (another, token) };
            if a.end <= b.start {
                let (first, second) = (input[a.clone()].to_vec(), input[b.clone()].to_vec());
                input.splice(b, first);
                input.splice(a, second);
            }
        }
        6 => {
            let all = lines(input);
            let line = random.pick(&all).clone();
            match random.below(3) {
                0 => drop(input.drain(line)),
                _ => {
                    let copy = input[line.clone()].to_vec();
                    input.splice(line.end..line.end, copy);
                }
            }
        }
        7 => {
            // Nesting deeper than a stack, or a text longer than any name.
            let depth = *random.pick(&[2, 130, 3000]);
            let what: Vec<u8> = match random.below(3) {
                0 => "[".repeat(depth).into_bytes(),
                1 => "{\"a\":".repeat(depth).into_bytes(),
                _ => format!("\"{}\"", "a".repeat(depth)).into_bytes(),
            };
            input.splice(token, what);
        }
        8 => {
            // Doubles what stands between two tokens, as a list that is too long.
            let end = (token.start + random.below(200)).min(input.len());
            let copy = input[token.start..end].to_vec();
            input.splice(end..end, copy);
        }
        _ => drop(input.drain(token)),
    }
}
