// Grasps for a cloud, with Rust's standard library alone; the body is the .npy file as it is.
//
//   apt-get install rustc
//   rustc --edition 2021 -O -o grasps examples/rust/grasps.rs
//   ./grasps [URL [CLOUD.npy]]
//
// A program with crates would take an HTTP client and a JSON reader from there; what stands in for them is below `main`.
use std::error::Error;
use std::io::{Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::time::Duration;

type Outcome<T> = Result<T, Box<dyn Error>>;

// Each value is URL-encoded JSON: %5B and %5D are brackets.
const OPTIONS: &str = "viewpoint=%5B0.38,0.55,0.48%5D&up=%5B0,0,1%5D&support_height=0.05&max_grasps=5";
const PATIENCE: Duration = Duration::from_secs(60);

fn run() -> Outcome<()> {
    let mut arguments = std::env::args().skip(1);
    let url = arguments.next().unwrap_or_else(|| "http://127.0.0.1:8000".into());
    let cloud = arguments.next().unwrap_or_else(|| "examples/clutter.npy".into());

    let body = std::fs::read(&cloud).map_err(|error| format!("{cloud}: {error}"))?;
    let (status, text) = post(&url, &format!("/grasps?{OPTIONS}"), "application/x-npy", &body)
        .map_err(|error| format!("{url}: {error}"))?;
    let answer = Json::parse(&text)?;
    if status != 200 {
        return Err(format!("{status}: {}", answer.get("detail")?.text()?).into());
    }
    let grasps = answer.get("grasps")?.list()?;
    if grasps.is_empty() {
        println!("no grasps: {}", answer.get("reason")?.text()?);
    }
    for grasp in grasps {
        let tcp = grasp.get("position")?.list()?.iter().map(Json::number).collect::<Outcome<Vec<_>>>()?;
        let (score, width) = (grasp.get("score")?.number()?, grasp.get("width")?.number()?);
        println!("{score:.2}  TCP at {:.3} {:.3} {:.3}  opening {width:.3} m", tcp[0], tcp[1], tcp[2]);
    }
    Ok(())
}

fn main() {
    if let Err(error) = run() {
        eprintln!("{error}");
        std::process::exit(1);
    }
}

// One request on a connection of its own: the status and the body of the answer.
fn post(url: &str, target: &str, content_type: &str, body: &[u8]) -> Outcome<(u16, String)> {
    let host = url.strip_prefix("http://").ok_or("not http://HOST:PORT")?.trim_end_matches('/');
    let address = if host.contains(':') { host.to_string() } else { format!("{host}:80") };
    let mut tried = address.to_socket_addrs()?.map(|one| TcpStream::connect_timeout(&one, PATIENCE));
    let first = tried.next().ok_or("no such host")?;
    let mut connection = first.or_else(|error| tried.find_map(Result::ok).ok_or(error))?;
    connection.set_read_timeout(Some(PATIENCE))?;
    connection.set_write_timeout(Some(PATIENCE))?;
    let head = format!(
        "POST {target} HTTP/1.1\r\nHost: {host}\r\nAccept: application/json\r\nConnection: close\r\n\
         Content-Type: {content_type}\r\nContent-Length: {}\r\n\r\n",
        body.len()
    );
    connection.write_all(head.as_bytes())?;
    connection.write_all(body)?;

    let mut answer = Vec::new();
    connection.read_to_end(&mut answer)?;
    let end = answer.windows(4).position(|four| four == b"\r\n\r\n").ok_or("no answer in HTTP")?;
    let (head, content) = (std::str::from_utf8(&answer[..end])?, &answer[end + 4..]);
    let status = head.split(' ').nth(1).ok_or("no status")?.parse()?;
    let header = |name: &str| {
        let mut lines = head.lines().skip(1).filter_map(|line| line.split_once(':'));
        lines.find(|(key, _)| key.eq_ignore_ascii_case(name)).map(|(_, value)| value.trim())
    };
    let content = match (header("transfer-encoding"), header("content-length")) {
        (Some(_), _) => joined(content)?,
        (_, Some(length)) => content.get(..length.parse()?).ok_or("the connection broke in mid-answer")?.to_vec(),
        _ => content.to_vec(), // ends with the connection
    };
    Ok((status, String::from_utf8(content)?))
}

// The content of a chunked body: each chunk is its length in hexadecimal, a line's end, its bytes, a line's end.
fn joined(mut chunks: &[u8]) -> Outcome<Vec<u8>> {
    let mut content = Vec::new();
    loop {
        let end = chunks.windows(2).position(|two| two == b"\r\n").ok_or("the connection broke in mid-answer")?;
        let length = std::str::from_utf8(&chunks[..end])?.split(';').next().unwrap_or_default();
        let length = usize::from_str_radix(length.trim(), 16)?;
        if length == 0 {
            return Ok(content);
        }
        chunks = &chunks[end + 2..];
        content.extend_from_slice(chunks.get(..length).ok_or("the connection broke in mid-answer")?);
        chunks = chunks.get(length + 2..).ok_or("the connection broke in mid-answer")?;
    }
}

enum Json {
    Number(f64),
    Text(String),
    List(Vec<Json>),
    Object(Vec<(String, Json)>),
    Other, // true, false, null
}

impl Json {
    fn parse(text: &str) -> Outcome<Json> {
        Reader { text, at: 0 }.value()
    }

    fn get(&self, name: &str) -> Outcome<&Json> {
        let members = if let Json::Object(members) = self { members } else { return Err("not a JSON object".into()) };
        let found = members.iter().find(|(key, _)| key == name);
        found.map(|(_, value)| value).ok_or_else(|| format!("no {name:?} in the answer").into())
    }

    fn list(&self) -> Outcome<&[Json]> {
        if let Json::List(items) = self {
            Ok(items)
        } else {
            Err("not a JSON list".into())
        }
    }

    fn text(&self) -> Outcome<&str> {
        if let Json::Text(text) = self {
            Ok(text)
        } else {
            Err("not a JSON string".into())
        }
    }

    fn number(&self) -> Outcome<f64> {
        if let Json::Number(number) = self {
            Ok(*number)
        } else {
            Err("not a JSON number".into())
        }
    }
}

// Reads JSON from where it is; what is read is a server's, so it says little of what is wrong.
struct Reader<'a> {
    text: &'a str,
    at: usize,
}

impl Reader<'_> {
    fn value(&mut self) -> Outcome<Json> {
        match self.peek()? {
            '{' => Ok(Json::Object(self.items('}', |reader| {
                let key = reader.string()?;
                reader.expect(':')?;
                Ok((key, reader.value()?))
            })?)),
            '[' => Ok(Json::List(self.items(']', Reader::value)?)),
            '"' => Ok(Json::Text(self.string()?)),
            _ => {
                let rest = &self.text[self.at..];
                let word =
                    &rest[..rest.find(|c: char| !c.is_alphanumeric() && !"+-.".contains(c)).unwrap_or(rest.len())];
                self.at += word.len();
                match word {
                    "true" | "false" | "null" => Ok(Json::Other),
                    _ => Ok(Json::Number(word.parse()?)),
                }
            }
        }
    }

    // What stands between brackets, with commas.
    fn items<T>(&mut self, close: char, item: impl Fn(&mut Self) -> Outcome<T>) -> Outcome<Vec<T>> {
        let mut items = Vec::new();
        self.at += 1;
        while self.peek()? != close {
            if !items.is_empty() {
                self.expect(',')?;
            }
            items.push(item(self)?);
        }
        self.at += 1;
        Ok(items)
    }

    fn string(&mut self) -> Outcome<String> {
        self.expect('"')?;
        let mut units: Vec<u16> = Vec::new(); // of UTF-16, which is what \u means
        loop {
            let next = self.next()?;
            let unit = match next {
                '"' => return Ok(String::from_utf16(&units)?),
                '\\' => match self.next()? {
                    'n' => '\n' as u16,
                    't' => '\t' as u16,
                    'r' => '\r' as u16,
                    'b' => 8,
                    'f' => 12,
                    'u' => {
                        let digits = self.text.get(self.at..self.at + 4).ok_or("JSON ends early")?;
                        self.at += 4;
                        u16::from_str_radix(digits, 16)?
                    }
                    other => other as u16, // a quote or a slash
                },
                other => {
                    units.extend_from_slice(other.encode_utf16(&mut [0; 2]));
                    continue;
                }
            };
            units.push(unit);
        }
    }

    fn next(&mut self) -> Outcome<char> {
        let next = self.text[self.at..].chars().next().ok_or("JSON ends early")?;
        self.at += next.len_utf8();
        Ok(next)
    }

    // The next character that is no space.
    fn peek(&mut self) -> Outcome<char> {
        let rest = &self.text[self.at..];
        self.at += rest.len() - rest.trim_start().len();
        rest.trim_start().chars().next().ok_or_else(|| "JSON ends early".into())
    }

    fn expect(&mut self, wanted: char) -> Outcome<()> {
        if self.peek()? != wanted {
            return Err(format!("JSON without a {wanted:?} where it belongs").into());
        }
        self.at += 1;
        Ok(())
    }
}
