// The log of a job, as it grows.

import { useEffect, useRef, useState } from "preact/hooks";

import { get } from "../api";
import type { LogPiece } from "../types";

const KEPT_CHARACTERS = 400_000;
const FIRST_BYTES = 100_000;

/** size: how long the log is now, as far as the page knows; fetched from there on. */
export function Log({ job, size }: { job: string; size: number }) {
  const [text, setText] = useState("");
  const [follow, setFollow] = useState(true);
  const next = useRef<number | null>(null);
  const busy = useRef(false);
  const box = useRef<HTMLPreElement>(null);
  useEffect(() => {
    let current = true;
    const fetchMore = async (): Promise<void> => {
      if (busy.current) return;
      busy.current = true;
      try {
        for (let more = true; more && current;) {
          const from = next.current ?? -FIRST_BYTES;
          const piece = await get<LogPiece>(`/v1/jobs/${job}/logs?from=${String(from)}`);
          next.current = piece.next;
          if (piece.text !== "") setText((old) => (old + piece.text).slice(-KEPT_CHARACTERS));
          more = piece.text !== "" && piece.next < piece.size;
        }
      } catch {
        // the next change of the size tries again
      } finally {
        busy.current = false;
      }
    };
    void fetchMore();
    return () => { current = false; };
  }, [job, size]);
  useEffect(() => {
    if (follow && box.current !== null) box.current.scrollTop = box.current.scrollHeight;
  }, [text, follow]);
  return (
    <>
      <pre
        ref={box} class="log" tabIndex={0} role="log" aria-label="Log" aria-live="off"
        onScroll={(event) => {
          const { scrollTop, scrollHeight, clientHeight } = event.currentTarget;
          setFollow(scrollHeight - scrollTop - clientHeight < 40);
        }}
      >{text === "" ? "Nothing yet." : text}</pre>
      <label class="check small"><input type="checkbox" checked={follow} onChange={(event) => { setFollow(event.currentTarget.checked); }} /> Follow the end</label>
    </>
  );
}
