// What several views need: data that is fetched again when asked, the place in the address, live events.

import { useCallback, useEffect, useRef, useState } from "preact/hooks";

import { get, troubleOf } from "./api";
import { follow, type ServerEvent } from "./events";

export interface Fetched<T> {
  data: T | null;
  trouble: { cause: string; hint: string } | null;
  again: () => void;
}

/** What the server says at `path`, fetched again by `again`; what was there stays until the new is, and when the path goes. */
export function useFetched<T>(path: string | null, load: (path: string, signal: AbortSignal) => Promise<T> = (p, signal) => get<T>(p, signal)): Fetched<T> {
  const [state, setState] = useState<Omit<Fetched<T>, "again">>({ data: null, trouble: null });
  const [round, setRound] = useState(0);
  useEffect(() => {
    if (path === null) return;
    const stop = new AbortController();
    load(path, stop.signal).then(
      (data) => {
        if (!stop.signal.aborted) setState({ data, trouble: null });
      },
      (error: unknown) => {
        if (!stop.signal.aborted) setState((old) => ({ data: old.data, trouble: troubleOf(error) }));
      },
    );
    return () => {
      stop.abort();
    };
  }, [path, round]);
  const again = useCallback(() => {
    setRound((n) => n + 1);
  }, []);
  return { ...state, again };
}

/** Calls `act` soon after the last call, but at most once in `ms`. */
export function useThrottled(act: () => void, ms: number): () => void {
  const waiting = useRef<ReturnType<typeof setTimeout> | null>(null);
  const latest = useRef(act);
  latest.current = act;
  useEffect(
    () => () => {
      if (waiting.current !== null) clearTimeout(waiting.current);
    },
    [],
  );
  return useCallback(() => {
    waiting.current ??= setTimeout(() => {
      waiting.current = null;
      latest.current();
    }, ms);
  }, [ms]);
}

/** Follows events as long as the view is there; returns whether the line is up. */
export function useEvents(path: string | null, take: (event: ServerEvent) => void): boolean {
  const [up, setUp] = useState(true);
  const latest = useRef(take);
  latest.current = take;
  useEffect(() => {
    if (path === null) return;
    const stop = new AbortController();
    void follow(path, stop.signal, (event) => {
      latest.current(event);
    }, setUp);
    return () => {
      stop.abort();
    };
  }, [path]);
  return up;
}

/** Does something every few seconds while the page is visible. */
export function useEvery(ms: number | null, act: () => void): void {
  const latest = useRef(act);
  latest.current = act;
  useEffect(() => {
    if (ms === null) return;
    const timer = setInterval(() => {
      if (document.visibilityState === "visible") latest.current();
    }, ms);
    return () => {
      clearInterval(timer);
    };
  }, [ms]);
}

/** What the tab of the browser is called. */
export function useTitle(words: string): void {
  useEffect(() => {
    document.title = `${words} · lvba`;
  }, [words]);
}

/** The place in the page, as parts of the address after #/. */
export function useRoute(): string[] {
  const [hash, setHash] = useState(location.hash);
  useEffect(() => {
    const changed = (): void => {
      setHash(location.hash);
    };
    addEventListener("hashchange", changed);
    return () => {
      removeEventListener("hashchange", changed);
    };
  }, []);
  return hash.replace(/^#\/?/, "").split("/").filter((part) => part !== "").map(decodeURIComponent);
}

export function go(...parts: string[]): void {
  location.hash = `#/${parts.map(encodeURIComponent).join("/")}`;
}
